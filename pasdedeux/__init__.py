"""The science of pasdedeux: arrays in, arrays out; no paths, no Arrow, no Dask, no Prefect."""
