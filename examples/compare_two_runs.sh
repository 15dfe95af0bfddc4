#!/bin/sh
# Change one key of a study, build it again (only its dependents are computed), and list the differences.
#   sh examples/compare_two_runs.sh flows/studies/duets.toml store
set -e
study=${1:-flows/studies/duets.toml} store=${2:-store}
newest() { ls "$store/runs" | grep -v latest | sort | tail -n 1; }
pasdedeux run "$study" --store "$store" --until augmentation
before=$(newest)
sleep 1
pasdedeux run "$study" --store "$store" --until augmentation --set 'augmentation.scales=[0.9]'
pasdedeux diff "$before" "$(newest)" --store "$store"
