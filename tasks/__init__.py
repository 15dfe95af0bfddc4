"""The functions that Dask runs: for each stage, plan its shards and compute one of them."""
