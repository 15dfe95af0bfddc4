#!/bin/sh
# Choose a draw and start new chains from it (Yin et al. 2018, section 5.3); edit the pair in the JSON file in between.
#   sh examples/restart_a_chain.sh duets store
set -e
study=${1:-duets} store=${2:-store}
pasdedeux show "draws:$study/ic-seed0#3" --store "$store"
pasdedeux restart "draws:$study/ic-seed0#3" --store "$store" --out restarts \
  --set chains.num_draws=20 --set chains.segment_draws=10
