"""``python keep_losses.py MODULE [FLAG ...]``: an experiment as at 30aa21d, whose frame models also
leave the loss of each update in ``curves.npz``. There they kept nothing of their training.
"""

import runpy
import sys

import numpy as np

from jaxdyna.experiments import frame_session

frame_session.PIECE_UPDATES = 1
make_pieces, play = frame_session.make_pieces, frame_session.Trainee.play
losses: list[np.ndarray] = []


def make_recorded(*args):
    start, proceed = make_pieces(*args)

    def recorded(run, work, hparams):
        run, out = proceed(run, work, hparams)
        if isinstance(work, tuple) and work[1]:
            losses.append(np.asarray(out["frame_loss"][0]))
        return run, out

    return start, recorded


def play_recorded(trainee, stage):
    losses.clear()
    play(trainee, stage)
    trainee.record.curves[f"{trainee.arm}@{stage}"]["frame_loss"] = np.stack(losses, axis=1)


frame_session.make_pieces = make_recorded
frame_session.Trainee.play = play_recorded
module = f"jaxdyna.experiments.{sys.argv.pop(1)}"
runpy.run_module(module, run_name="__main__", alter_sys=True)
