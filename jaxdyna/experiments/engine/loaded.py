"""What a run left, from Python: `jaxdyna.load`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxdyna.envs import register
from jaxdyna.experiments.engine import storage, trained
from jaxdyna.experiments.engine.experiment import Entry, Experiment, Study
from jaxdyna.experiments.engine.record import FORMAT, recorded
from jaxdyna.experiments.engine.trained import EPISODES, REAL, RETURN, WHOSE, Keeper, Trained
from jaxdyna.experiments.engine.work import DIVERGED, HOOKS, Curves, Engine, Runs, Work, runs_of
from jaxdyna.experiments.report import frames
from jaxdyna.fields import check_counts
from jaxdyna.watched import Scene, Shot

FILMED = 200


def load(folder: str | Path, *parts: Experiment | Study) -> Loaded:
    """Opens the folder of a run, wherever it lies. Nothing in it is run as code, but the module of
    its experiment, and of a world of one's own, is imported by the name that it says. `ValueError`
    where there is no result, or it is damaged or a later version's, or its experiment is not found.

    Args:
        folder: that ``--out`` named.
        parts: the experiment that was played, where it is in no module that can be imported.
    """
    folder = Path(folder)
    results = storage.read_json(folder / "results.json")
    if results is None or "part" not in results:
        raise ValueError(f"{folder} has no result of a run: name the folder that --out named")
    if results.get("format", FORMAT) > FORMAT:
        raise ValueError(f"{folder} is of a later version of jaxdyna: update this one")
    experiment, options, every = recorded(results, parts)
    curves = storage.read_curves(folder / "curves.npz", storage.identity(results))
    entries = {entry.name: entry for entry in every}
    return Loaded(folder, experiment, results, options, curves, entries)


@dataclass(frozen=True, repr=False)
class Loaded:
    """What a run left."""

    folder: Path  #: where it lies
    experiment: Experiment  #: what was played
    #: its ``results.json``; ``results["config"]`` are the settings as JSON
    results: storage.Results
    options: Any  #: the settings, resolved
    #: by arm and name, arrays ``[runs, ...]``, NaN after a run's own end
    curves: Mapping[str, Curves]
    entries: Mapping[str, Entry]  #: every arm that there can be, by name
    stage: int | None = None  #: the real episode after which runs are opened; None: their last

    def __repr__(self) -> str:
        kept = ", ".join(f"{arm}: {len(self.kept.get(arm, []))} kept" for arm in self.curves)
        return f"<{self.folder}{f' at {self.stage}' if self.stage else ''}: {kept}>"

    def at(self, stage: int) -> Loaded:
        """The same after so many real episodes, or a run's own last: what is asked for is played
        again up to there, kept or not, to the same bits on the same kind of machine. Below 1 it is
        `ValueError`.
        """
        check_counts(stage=stage)
        return replace(self, stage=stage)

    @cached_property
    def kept(self) -> dict[str, list[int]]:
        """The seeds whose policy and dreams can be had, by arm."""
        seeds = np.array(self.results["runs"]["seeds"])
        found = {arm: self._there(arm, one) for arm, one in self.curves.items()}
        return {arm: seeds[which].tolist() for arm, which in found.items() if which.any()}

    def _there(self, arm: str, own: Curves) -> np.ndarray:
        """Of which runs it can be had, bool ``[runs]``, or one for all."""
        if self.stage is None:
            return np.isfinite(own.get(RETURN, np.array(np.nan)))
        broken = own.get(DIVERGED, np.zeros((len(self.results["runs"]["seeds"]), 1)))
        acts = self.entries[arm].make().work.trained is not None
        return np.array([acts and not (run[: self.stage] > 0).any() for run in broken])

    def trained(self, arm: str, seed: int | None = None) -> Trained:
        """What a run has learned, by default the first that is kept of its arm. `ValueError` where
        it is not kept, or what is kept is damaged, another run's or another version's.
        """
        keeper, kept, _, hparams = self._run(arm, seed)
        act = jax.jit(lambda kept, obs, key: keeper.opened(kept, hparams).policy(obs, key))
        return keeper.opened(kept, hparams)._replace(policy=partial(act, kept))

    def returns(self, arm: str, seed: int | None = None, episodes: int = EPISODES) -> np.ndarray:
        """Of its policy in new episodes of the true environment, ``[episodes]``. Of as many as in
        the report the mean is the report's, to the last digit on the same kind of machine.
        `ValueError` as `trained`.
        """
        check_counts(episodes=episodes)
        keeper, kept, key, hparams = self._run(arm, seed)
        return np.asarray(keeper.play(kept, key, hparams, episodes), np.float64)

    def film(
        self, path: str | Path | None = None, arms: Sequence[str] = (), seed: int | None = None
    ) -> None:
        """Films an episode of kept policies, the first `FILMED` steps, from the same start for all
        arms, and beside each a dream that begins where it does and takes the same actions, see
        `jaxdyna.watched.Scene`. `ValueError` as `trained`, and where a world cannot be watched.

        Args:
            path: of a GIF, or with the ``film`` extra an MP4; by default of the report's.
            arms: by default all that keep any.
            seed: of the run, by default the first that is kept of each arm.
        """
        columns: dict[str, list[Shot]] = {}
        frames.check_film(path := Path(path or self.folder / frames.FILM))
        scenes = self.scenes(arms, seed)
        for arm, (run, scene) in scenes.items():
            shots = scene.played(run.policy, self.options.seed, min(FILMED, run.num_steps))
            columns |= {f"{arm}: {side}": [shot[side] for shot in shots] for side in scene.sides}
        frames.film(path, columns, max(len(scene.sides) for _, scene in scenes.values()))

    def scenes(
        self, arms: Sequence[str] = (), seed: int | None = None
    ) -> dict[str, tuple[Trained, Scene]]:
        """What runs learned, by arm, and their worlds to watch, see `film`; dreams come first."""
        runs = {arm: self.trained(arm, seed) for arm in arms or self.kept}
        if not runs:
            raise ValueError(f"{self.folder} keeps no policy: play with --keep-runs above 0")
        scenes = {
            arm: (run, Scene(run.env, run.params, run.dream, run.dream_params))
            for arm, run in runs.items()
        }
        return dict(sorted(scenes.items(), key=lambda one: -len(one[1][1].sides)))

    def register(
        self, env_id: str, arm: str | None = None, seed: int | None = None, **spec: Any
    ) -> None:  # fmt: skip
        """Registers a run's dream with Gymnasium, see `jaxdyna.envs.register`; by default that of
        the first arm that has one. `ValueError` as `trained`, and where there is no dream.
        """
        runs = (self.trained(name, seed) for name in ([arm] if arm else self.kept))
        found = next((run for run in runs if run.dream is not None), None)
        if found is None or found.dream is None:
            raise ValueError(f"no dream is kept in {self.folder}{f' of {arm}' if arm else ''}")
        register(env_id, found.dream, found.dream_params, **spec)

    def _run(self, arm: str, seed: int | None) -> tuple[Keeper, Mapping[str, Any], Any, Any]:
        """What opens a run, what is kept of it, the key of its judging, and its hparams."""
        if arm in self.results.get("unfinished", ()):
            raise ValueError(f"{arm} in {self.folder} is not finished: --resume goes on with it")
        if arm not in self.curves:
            raise ValueError(f"{self.folder} has no arm {arm}: there are {', '.join(self.curves)}")
        made, seeds = self.entries[arm].make(), self.kept.get(arm, [])
        if made.work.trained is None:
            raise ValueError(f"the arm {arm} keeps no policy: it acts by planning")
        seed = seed if seed is not None or not seeds else seeds[0]
        if seed not in seeds:
            why = (
                "--keep-runs says of how many runs" if self.stage is None else "others broke before"
            )
            raise ValueError(
                f"of {arm} in {self.folder} the seeds {seeds} are kept, not {seed}: {why}"
            )
        runs = runs_of([made], [seed], self.options.seed)
        row = self.results["runs"]["seeds"].index(seed)
        hparams = jax.tree.map(itemgetter(0), runs.hparams)
        own = {name: values[row] for name, values in self.curves[arm].items() if name in WHOSE}
        if self.stage is None:
            kept = trained.read(self.folder, arm, seed, own)
        else:
            kept = self._again(made.work, runs, min(self.stage, np.isfinite(own[REAL]).sum()))
        keeper = Keeper(made.work.init, made.work.trained, hparams)
        if said := keeper.differs(kept):
            raise ValueError(f"{arm} in {self.folder} was kept by another version: {said}")
        return keeper, kept, jax.random.fold_in(runs.judging[0], HOOKS.index("keep")), hparams

    def _again(self, work: Work, runs: Runs, units: int) -> Mapping[str, Any]:
        """What one run has learned after so many units."""
        played = Engine(keep=runs.seed[0] + 1).play(work, runs._replace(units=np.array([units])))
        return trained.apart(played.curves[0])[0]
