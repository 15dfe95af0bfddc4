#!/bin/sh
# Reject a variant by hand, with a reason; exports, training and published datasets then leave it out.
#   sh examples/curate_variants.sh duets store
set -e
study=${1:-duets} store=${2:-store}
pasdedeux curate reject "variants:$study/waltz#0" --reason "the free arm hangs" --store "$store" --curation choices.txt
pasdedeux export "variants:$study/waltz" --store "$store" --curation choices.txt --format csv --out without_it
pasdedeux curate undo "variants:$study/waltz#0" --store "$store" --curation choices.txt
