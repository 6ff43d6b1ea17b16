"""What data a CartPole model needs: diverse or of one policy (§3.1.1), and error against horizon.

In each run a policy is trained; the model is then fitted to equally many transitions from three
sources, and each fit is judged on new episodes of three policies.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from jaxdyna import replay
from jaxdyna.dyna import Dyna, DynaConfig, DynaHParams, Metrics, make_train
from jaxdyna.experiments.cartpole.arms import Dreams, parts
from jaxdyna.experiments.cartpole.model import explained
from jaxdyna.experiments.cartpole.options import TUNED
from jaxdyna.experiments.engine import Arm, Experiment, Options, Work
from jaxdyna.experiments.report import plots
from jaxdyna.experiments.report import sections as report
from jaxdyna.experiments.report.summaries import Curves, mean_of_runs
from jaxdyna.experiments.report.tables import Results, Table, markdown_table, runs, with_interval
from jaxdyna.fields import changed, setting
from jaxdyna.models.evaluation import one_step_sums, open_loop
from jaxdyna.rollout import rollout
from jaxdyna.types import DynamicsModel, Key, Transition

SOURCES = ("random policy", "trained policy", "all policies of a learning run")
JUDGES = {
    "random policy": 1.0,
    "trained policy": 0.0,
    "trained policy, half its actions random": 0.5,
}
"""And the share of their actions at random."""
HORIZON = 50
SHOWN_STEPS = (1, 10, 25, HORIZON)
ARM = "study"


@dataclass(frozen=True, kw_only=True)
class DataOptions(Options):
    """CartPole's model, as tuned, on data of one policy and of many."""

    decided: ClassVar = {"stop_after_solved": "the study, whose runs go on to the end"}

    seeds: int = setting(20, "runs", at_least=1, everyday=True)
    episodes: int = setting(
        300, "real episodes of the learning run that trains the policy", at_least=1, everyday=True
    )
    transitions: int = setting(4000, "transitions that each model gets", at_least=1, everyday=True)
    updates: int = setting(6000, "gradient steps of each model", at_least=1, everyday=True)
    judged_episodes: int = setting(
        20, "new episodes of each policy that the models are judged on", at_least=1, everyday=True
    )


class Setup(NamedTuple):
    """What is learned with."""

    dyna: Dyna
    model: DynamicsModel
    config: DynaConfig
    hparams: DynaHParams


@cache
def work(options: DataOptions) -> Work:
    """A run in one unit."""
    tuned = changed(
        TUNED, {"episodes": options.episodes, "dyna.model_updates": 0, "dyna.num_real_first": 0}
    ).resolved()
    dyna = parts(tuned.agent, tuned.model, Dreams("observed", 0.0, False))
    dyna, model = dyna._replace(dream=None, diagnose=None), dyna.model
    assert model is not None
    setup, learn = Setup(dyna, model, tuned.dyna, tuned.hparams), make_train(dyna, tuned.dyna)

    def study(key: Key) -> Metrics:
        """``r2`` ``[source, judge]`` and ``open_loop`` ``[source, HORIZON]``."""
        key_run, key_play, key_fit, key_test, key_judge = jax.random.split(key, 5)
        state, _ = learn(key_run, setup.hparams)
        policies = [_policy(setup, state.agent, share) for share in JUDGES.values()]
        found = [
            _single(setup, act, key, options.transitions)
            for act, key in zip(policies[:2], jax.random.split(key_play, 2), strict=True)
        ]
        found.append(replay.sample_distinct(state.replay, key_test, options.transitions))
        keys = jax.random.split(key_fit, len(SOURCES))
        fitted = [
            _fit(setup, key, data, options.updates) for key, data in zip(keys, found, strict=True)
        ]
        return _judge(setup, fitted, policies, key_judge, options.judged_episodes)

    return Work(
        init=lambda key, _: key,
        step=lambda key, _, unit, hparams: (jax.random.clone(key), study(key)),
        piece=1, block=options.block,
    )  # fmt: skip


def _policy(setup: Setup, agent: Any, random_share: float) -> Any:
    def act(obs, key):
        key_policy, key_random, key_which = jax.random.split(key, 3)
        action = setup.dyna.agent.act(agent, obs, key_policy, setup.hparams.agent)
        at_random = jax.random.randint(key_random, (), 0, setup.dyna.env.num_actions)
        return jnp.where(jax.random.bernoulli(key_which, random_share), at_random, action)

    return act


def _single(setup: Setup, act: Any, key: Key, count: int) -> Transition:
    """``count`` transitions of one policy, none twice, drawn from whole episodes of it."""
    key_play, key_sample = jax.random.split(key)
    # From so close to upright no episode falls within 8 steps: these always hold enough.
    episodes = rollout(
        setup.dyna.env, act, key_play, setup.hparams.env, -(-count // 8),
        num_steps=setup.config.num_steps,
    )  # fmt: skip
    example = jax.tree.map(lambda leaf: leaf[0, 0], episodes)
    held = replay.add(replay.init(episodes.mask.size, example), episodes, episodes.mask)
    return replay.sample_distinct(held, key_sample, count)


def _fit(setup: Setup, key: Key, data: Transition, updates: int) -> Any:
    """The model's parameters after so many gradient steps."""
    key_init, key_rows, key_update = jax.random.split(key, 3)
    shape = (updates, setup.config.model_batch)
    rows = jax.random.randint(key_rows, shape, 0, data.mask.shape[0])

    def update(carry, rows):
        state, key = carry
        key, key_now = jax.random.split(key)
        batch = jax.tree.map(lambda leaf: leaf[rows], data)
        state, _ = setup.model.update(state, batch, key_now, setup.hparams.model)
        return (state, key), None

    start = (setup.model.init(key_init, setup.hparams.model), key_update)
    return jax.lax.scan(update, start, rows)[0][0].params


def _judge(setup: Setup, fitted: list, policies: list, key: Key, episodes: int) -> Metrics:
    key_play, key_sums, key_open = jax.random.split(key, 3)
    tests = [
        rollout(setup.dyna.env, act, key, setup.hparams.env, episodes,
                num_steps=setup.config.num_steps)
        for act, key in zip(policies, jax.random.split(key_play, len(JUDGES)), strict=True)
    ]  # fmt: skip
    models, kinds = (jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
                     for each in (fitted, tests))  # fmt: skip
    sums_of = jax.vmap(one_step_sums(setup.model.predict), (None, 0, 0))
    keys = jax.random.split(key_sums, (len(SOURCES), len(JUDGES)))
    sums = jax.vmap(sums_of, (0, None, 0))(models, kinds, keys)
    errors_of = jax.vmap(lambda params, keys: _open_loop_error(setup.model, params, tests[1], keys))
    errors = errors_of(models, jax.random.split(key_open, (len(SOURCES), episodes)))
    return {"r2": explained(sums, "change").mean(-1), "open_loop": errors}


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


def describe(options: DataOptions, curves: Curves) -> Results:
    """``change_r2`` by source and judge, ``open_loop_error`` by source and dreamed step."""
    explained, errors = curves["r2"][:, 0], curves["open_loop"][:, 0]
    return {
        "change_r2": {
            source: {name: mean_of_runs(explained[:, row, at]) for at, name in enumerate(JUDGES)}
            for row, source in enumerate(SOURCES)
        },
        "open_loop_error": {
            source: {str(step): mean_of_runs(errors[:, row, step - 1]) for step in SHOWN_STEPS}
            for row, source in enumerate(SOURCES)
        },
    }


def tables(record: Any) -> list[tuple[str, Table]]:
    """Both, with their titles."""

    def table(rows: Results) -> Table:
        lines = [
            [name, *(with_interval(said, 3) for said in row.values())] for name, row in rows.items()
        ]
        return ["trained on", *next(iter(rows.values()))], lines

    said = record.results["arms"][ARM]
    return [(name, table(said[name])) for name in ("change_r2", "open_loop_error")]


def section(record: Any) -> str:
    """The tables, and ``horizon.png``."""
    options, errors = record.options, record.curves[ARM]["open_loop"][:, 0]
    by_source = {source: errors[:, row] for row, source in enumerate(SOURCES)}
    plots.bands(record.out / "horizon.png", {"": by_source}, "dreamed steps",
                "error (standard deviations)", legend="trained on", yscale="log")  # fmt: skip
    (_, ahead), (_, fed) = tables(record)
    return report.paragraphs(
        f"{runs(len(errors))}. In each a policy is trained on {options.episodes} real episodes; "
        f"the `tuned` preset's model is then fitted {len(SOURCES)} times, each time with "
        f"{options.updates:,} updates on {options.transitions:,} transitions, and judged on "
        f"{options.judged_episodes} new episodes of each policy.",
        "## One step ahead",
        "Share of the variance of a step's change that is explained (R², mean of the four state "
        "variables; mean over runs and 95% interval). Columns: who played the episodes that it is "
        "judged on.",
        markdown_table(*ahead),
        "## Fed with its own predictions",
        "Root mean square error on episodes of the trained policy, by dreamed step, in standard "
        "deviations of the state.",
        markdown_table(*fed),
        "![error against horizon](horizon.png)",
    )


DATA = Experiment(
    name="data",
    title="What data does a CartPole model need?",
    presets={"tuned": DataOptions(block=5)},
    quick={"tuned": {"seeds": 2, "episodes": 100, "updates": 1000}},
    arms=lambda options: {ARM: lambda: Arm(work(options), (), units=1)},
    describe=(describe,),
    sections=(section, report.settings, report.spent),
    summary=tables,
)
