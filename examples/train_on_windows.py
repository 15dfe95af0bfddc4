"""Train a small network that predicts a variant from its source and the scales of its bones.

    python examples/train_on_windows.py variants:duets --store store --steps 500

It prints the mean error of joints in centimetres, and that of the unchanged source.
"""

from __future__ import annotations

import argparse
import itertools

import torch
from torch.utils.data import DataLoader

from pasdedeux.data import PairDataset, PairStream

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("reference", help="variants:STUDY, variants:NAME@VERSION or variants:FOLDER")
arguments.add_argument("--store", default="store")
arguments.add_argument("--window", type=int, default=30)
arguments.add_argument("--steps", type=int, default=500)
arguments.add_argument("--workers", type=int, default=0)
options = arguments.parse_args()

torch.manual_seed(0)
fields = ("positions", "source", "scales")
windows = PairDataset(options.reference, options.window, store=options.store, fields=fields, is_normalised=True)
size_m = torch.from_numpy(windows.normaliser.deviation)
network = torch.nn.Sequential(torch.nn.Linear(2 * 22 * 4, 256), torch.nn.GELU(), torch.nn.Linear(256, 2 * 22 * 3))
optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
stream, step = PairStream(windows, batch_size=64), 0
for epoch in itertools.count():
    stream.set_epoch(epoch)
    batches = DataLoader(stream, batch_size=None, num_workers=options.workers)
    for batch in itertools.islice(batches, options.steps - step):
        source, scales = batch["source"], batch["scales"][:, None].expand(-1, options.window, -1, -1)
        moved = network(torch.cat([source.flatten(2), scales.flatten(2) - 1.0], dim=-1)).view_as(source)
        error_m = (source + moved - batch["positions"]) * size_m
        optimiser.zero_grad()
        error_m.square().mean().backward()
        optimiser.step()
        step += 1
        if step % 100 == 0 or step == options.steps:
            mean_cm = [100.0 * x.norm(dim=-1).mean() for x in (error_m, (source - batch["positions"]) * size_m)]
            print(f"step {step}: {mean_cm[0]:.2f} cm; the source as it is {mean_cm[1]:.2f} cm")
    if step >= options.steps:
        break
