"""What Dask runs: for each stage, the plan of its shards and the work of one shard, as plain functions."""
