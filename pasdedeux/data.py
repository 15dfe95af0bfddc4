"""Takes, variants, draws and contacts of a store, and windows to train on: `from pasdedeux.data import Data`.

Everything is defined in `tasks.data` and `tasks.windows`, and can be imported from there too.
"""

import sys

try:
    from tasks.data import Clip, Data, Pairs
    from tasks.windows import PairDataset, PairStream
except ModuleNotFoundError as error:
    if error.name not in ("tasks.data", "tasks.windows"):
        raise
    hiding = sys.modules["tasks"].__path__[0]
    raise ImportError(f"the folder {hiding} hides `tasks` of pasdedeux: rename it, or start Python elsewhere") from None

__all__ = ["Clip", "Data", "PairDataset", "PairStream", "Pairs"]
