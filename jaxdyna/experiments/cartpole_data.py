"""What data a CartPole model needs: diverse or single-policy (§3.1.1), and error against horizon.

``python -m jaxdyna.experiments.cartpole_data`` trains the paper's model on equally many transitions
from three sources and judges each on new episodes of three policies.
"""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxdyna import replay, rollout, sweep
from jaxdyna.dyna import make_train
from jaxdyna.experiments import cli, plots_studies, report
from jaxdyna.experiments.cartpole import make_arms
from jaxdyna.experiments.cartpole_options import PAPER
from jaxdyna.experiments.run import Arm
from jaxdyna.experiments.storage import plain, write_curves, write_json, write_text
from jaxdyna.models.evaluation import one_step_sums, open_loop
from jaxdyna.statistics import bootstrap_interval, r_squared
from jaxdyna.types import DynamicsModel, Key, Transition

PROG = "python -m jaxdyna.experiments.cartpole_data"
SOURCES = ("random policy", "trained policy", "all policies of a learning run")
JUDGES = ("random policy", "trained policy", "trained policy, half its actions random")
HORIZON = 50


@dataclass(frozen=True)
class Options:
    """The paper's CartPole model on data of one policy and of many."""

    preset: str = "paper"
    """Only paper: whose agent and model are used."""
    seeds: int = 20
    """Runs, all in one jitted program."""
    seed: int = 0
    """Base seed."""
    episodes: int = 300
    """Real episodes of the learning run that trains the policy."""
    transitions: int = 4000
    """Transitions that each model gets."""
    updates: int = 6000
    """Gradient steps of each model."""
    judged_episodes: int = 20
    """New episodes of each policy that the models are judged on."""
    out: Path = Path("runs/cartpole-data")
    """Folder for the results."""

    def __post_init__(self) -> None:
        cli.check_common(self)
        if self.preset != "paper":
            raise ValueError(f"--preset is {self.preset}: there is paper")
        for name in ("transitions", "updates", "judged_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')} must be at least 1")


def make_study(options: Options) -> Any:
    """``study(key, _) -> {"sums": ..., "open_loop": ...}`` with leading axes ``[source, judge]``
    and ``[source]``.
    """
    setup = replace(PAPER, episodes=options.episodes, model_updates=0, real_first=0)
    arm = make_arms(setup)["dyna"]
    arm = arm._replace(dyna=arm.dyna._replace(dream=None, diagnose=None))
    model = arm.dyna.model
    assert model is not None
    learn = make_train(arm.dyna, arm.config)

    def study(key: Key, _: Any) -> dict[str, Any]:
        key_run, key_play, key_fit, key_test, key_judge = jax.random.split(key, 5)
        state, _ = learn(key_run, arm.hparams)
        policies = [_policy(arm, state, share) for share in (1.0, 0.0, 0.5)]
        keys = jax.random.split(key_play, 2)
        parts = [
            _single(arm, act, key, options.transitions)
            for act, key in zip(policies[:2], keys, strict=True)
        ]
        parts.append(replay.sample_distinct(state.replay, key_test, options.transitions))
        keys = jax.random.split(key_fit, len(SOURCES))
        fitted = [
            _fit(model, arm, key, data, options.updates)
            for key, data in zip(keys, parts, strict=True)
        ]
        return _judge(model, arm, fitted, policies, key_judge, options.judged_episodes)

    return study


def _policy(arm: Arm, state: Any, random_share: float) -> Any:
    def act(obs, key):
        key_policy, key_random, key_which = jax.random.split(key, 3)
        action = arm.dyna.agent.act(state.agent, obs, key_policy, arm.hparams.agent)
        at_random = jax.random.randint(key_random, (), 0, arm.dyna.env.num_actions)
        return jnp.where(jax.random.bernoulli(key_which, random_share), at_random, action)

    return act


def _single(arm: Arm, act: Any, key: Key, count: int) -> Transition:
    """``count`` transitions of one policy, none twice, drawn from whole episodes of it."""
    key_play, key_sample = jax.random.split(key)
    # From so close to upright no episode falls within 8 steps: these always hold enough.
    episodes = rollout(arm.dyna.env, act, key_play, arm.hparams.env, -(-count // 8))
    example = jax.tree.map(lambda leaf: leaf[0, 0], episodes)
    held = replay.add(replay.init(episodes.mask.size, example), episodes, episodes.mask)
    return replay.sample_distinct(held, key_sample, count)


def _fit(model: DynamicsModel, arm: Arm, key: Key, data: Transition, updates: int) -> Any:
    key_init, key_rows, key_update = jax.random.split(key, 3)
    shape = (updates, arm.config.model_batch)
    rows = jax.random.randint(key_rows, shape, 0, data.mask.shape[0])

    def update(carry, rows):
        state, key = carry
        key, key_now = jax.random.split(key)
        batch = jax.tree.map(lambda leaf: leaf[rows], data)
        state, _ = model.update(state, batch, key_now, arm.hparams.model)
        return (state, key), None

    start = (model.init(key_init, arm.hparams.model), key_update)
    return jax.lax.scan(update, start, rows)[0][0].params


def _judge(model: DynamicsModel, arm: Arm, fitted: list, policies: list, key: Key, episodes: int):
    key_play, key_sums, key_open = jax.random.split(key, 3)
    tests = [
        rollout(arm.dyna.env, act, key, arm.hparams.env, episodes)
        for act, key in zip(policies, jax.random.split(key_play, len(JUDGES)), strict=True)
    ]
    stack = lambda *leaves: jnp.stack(leaves)  # noqa: E731
    models, kinds = jax.tree.map(stack, *fitted), jax.tree.map(stack, *tests)
    judge = one_step_sums(model.predict)
    keys = jax.random.split(key_sums, (len(SOURCES), len(JUDGES)))
    sums = jax.vmap(jax.vmap(judge, (None, 0, 0)), (0, None, 0))(models, kinds, keys)
    balanced = tests[1]
    keys = jax.random.split(key_open, (len(SOURCES), episodes))
    errors = jax.vmap(lambda params, keys: _open_loop_error(model, params, balanced, keys), (0, 0))(
        models, keys
    )
    return {"sums": sums, "open_loop": errors}


def _open_loop_error(model: DynamicsModel, params: Any, episodes: Transition, keys: Key):
    """Root mean square error after each of `HORIZON` dreamed steps, in standard deviations of the
    true state over the episodes, ``[HORIZON]``.
    """

    def dream(obs, action, key):
        return open_loop(model.predict, params, obs, action, key).next_obs

    actions = episodes.action[:, :HORIZON]
    dreamed = jax.vmap(dream)(episodes.obs[:, 0], actions, keys)
    valid = episodes.mask[..., None]
    count = episodes.mask.sum()
    mean = (episodes.obs * valid).sum((0, 1)) / count
    std = jnp.sqrt((jnp.square(episodes.obs - mean) * valid).sum((0, 1)) / count)
    square = jnp.square((dreamed - episodes.next_obs[:, :HORIZON]) / std).mean(-1)
    alive = episodes.mask[:, :HORIZON]
    return jnp.sqrt(jnp.where(alive, square, 0).sum(0) / alive.sum(0))  # NaN where all have ended


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the study from the command line; returns the exit code."""
    options = cli.parse({"paper": Options()}, argv, PROG)
    try:
        cli.check_writable(options.out)
    except ValueError as error:
        cli.fail(str(error), PROG)
    console = Console(highlight=False)
    console.print(f"{options.seeds} learning runs, {len(SOURCES)} models each ...")
    began = time.perf_counter()
    keys = jax.random.split(jax.random.key(options.seed), options.seeds)
    outcome = jax.tree.map(lambda leaf: np.asarray(leaf[0]), sweep(make_study(options), keys, 0.0))
    sums, errors = outcome["sums"], outcome["open_loop"]
    explained = r_squared(
        sums["state_error"], sums["change_sum"], sums["change_square"], sums["count"]
    ).mean(-1)
    arguments = sys.argv[1:] if argv is None else argv
    results = {
        "experiment": "cartpole_data",
        "command": f"{PROG} {shlex.join(arguments)}".strip(),
        "preset": options.preset,
        "config": plain(options),
        **report.environment(),
        "timing": {"total_s": time.perf_counter() - began},
        "change_r2": {
            source: {
                judge: _summary(explained[:, row, column]) for column, judge in enumerate(JUDGES)
            }
            for row, source in enumerate(SOURCES)
        },
        "open_loop_error": {
            source: {str(step): _summary(errors[:, row, step - 1]) for step in (1, 10, 25, HORIZON)}
            for row, source in enumerate(SOURCES)
        },
    }
    by_source = {source: errors[:, row] for row, source in enumerate(SOURCES)}
    write_json(options.out / "results.json", results)
    write_curves(options.out / "curves.npz", {"study": {"open_loop": errors, "r2": explained}})
    plots_studies.error_growth(options.out / "horizon.png", by_source)
    write_text(options.out / "report.md", _markdown(results, options))
    for part in ("change_r2", "open_loop_error"):
        report.print_table(console, part, *_table(results[part]))
    console.print(f"Report: {options.out / 'report.md'}")
    return 0


def _summary(values: np.ndarray) -> dict[str, Any]:
    ends = bootstrap_interval(values, lambda rows: rows.mean(-1))
    return {"mean": float(values.mean()), "ci95": ends, "per_seed": values.tolist()}


def _table(rows: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    header = ["trained on", *next(iter(rows.values()))]
    cells = [
        [name, *(f"{v['mean']:.3f} ({report.interval(v['ci95'], 3)})" for v in row.values())]
        for name, row in rows.items()
    ]
    return header, cells


def _markdown(results: dict[str, Any], options: Options) -> str:
    parts = [
        "# What data does a CartPole model need?",
        f"`{results['command']}`",
        f"{report.runs(options.seeds)}. In each a policy is trained on {options.episodes} real "
        f"episodes; the paper preset's model is then fitted {len(SOURCES)} times, each time with "
        f"{options.updates:,} updates on {options.transitions:,} transitions, and judged on "
        f"{options.judged_episodes} new episodes of each policy.",
        "## One step ahead",
        "Share of the variance of a step's change that is explained (R², mean of the four state "
        "variables; mean over runs and 95% interval). Columns: who played the episodes that it is "
        "judged on.",
        report.markdown_table(*_table(results["change_r2"])).rstrip(),
        "## Fed with its own predictions",
        "Root mean square error on episodes of the trained policy, by dreamed step, in standard "
        "deviations of the state.",
        report.markdown_table(*_table(results["open_loop_error"])).rstrip(),
        "![error against horizon](horizon.png)",
    ]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    sys.exit(main())
