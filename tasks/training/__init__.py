"""Stage `training`: models of augmentation, trained on the training set of a split and tested on the rest."""

from __future__ import annotations

from tasks.stage import Stage
from tasks.training.parameters import TrainingParameters
from tasks.training.plan import TRAINING, check_study, plan
from tasks.training.run import run_shard

__all__ = ["STAGE"]

STAGE = Stage(
    *TRAINING,
    reads=("variants", "variant_quality", "poses"),
    writes=("models", "model_states", "training_log"),
    parameters=TrainingParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="Models that give a pair's motion for new body proportions",
    check_study=check_study,
    needs="variants ([augmentation] of takes of two people)",
)
