"""The one engine: it plays, saves, resumes, sweeps, shards and reports any experiment."""

from jaxdyna.experiments.engine.experiment import Experiment, Options, Overrides, Record, Study
from jaxdyna.experiments.engine.progress import shown
from jaxdyna.experiments.engine.session import main
from jaxdyna.experiments.engine.storage import InputError, Results
from jaxdyna.experiments.engine.trained import Trained
from jaxdyna.experiments.engine.work import Arm, Curves, Engine, Runs, Work, runs_of

__all__ = [
    "Arm", "Curves", "Engine", "Experiment", "InputError", "Options", "Overrides", "Record",
    "Results", "Runs", "Study", "Trained", "Work", "main", "runs_of", "shown"]  # fmt: skip
