"""What data a CartPole model needs: diverse or of one policy (§3.1.1), and error against horizon.

In each run a policy is trained; the model is then fitted to equally many transitions from three
sources, and each fit is judged on new episodes of three policies.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.dyna import DynaConfig, DynaHParams, DynaState, Metrics, make_train, train_model
from jaxdyna.experiments.cartpole.arms import parts
from jaxdyna.experiments.cartpole.options import TUNED
from jaxdyna.experiments.engine import Arm, Experiment, Options, Work
from jaxdyna.experiments.report import plots, sections as report, tables
from jaxdyna.experiments.report.summaries import Curves, by_class
from jaxdyna.fields import changed, setting
from jaxdyna.models.evaluation import one_step_sums, open_loop, r_squared
from jaxdyna.replay import ring
from jaxdyna.rollout import rollout
from jaxdyna.types import Key, Transition

SOURCES = ("random policy", "trained policy", "all policies of a learning run")
HALF = "trained policy, half its actions random"
#: whose new episodes models are judged on, and the share of their actions at random
JUDGES = {"random policy": 1.0, "trained policy": 0.0, HALF: 0.5}
HORIZON = 50
SHOWN_STEPS = (1, 10, 25, HORIZON)
ARM = "study"


@dataclass(frozen=True, kw_only=True)
class DataOptions(Options):
    """CartPole's model, as tuned, on data of one policy and of many."""

    decided: ClassVar = {"stop_after_solved": "the study, whose runs go on to the end"}

    transitions: int = setting(4000, "transitions that each model gets", at_least=1, everyday=True)
    updates: int = setting(6000, "gradient steps of each model", at_least=1, everyday=True)
    judged_episodes: int = setting(
        20, "new episodes of each policy that the models are judged on", at_least=1, everyday=True
    )


class Setup(NamedTuple):
    """What is learned with."""

    dyna: Any
    config: DynaConfig
    hparams: DynaHParams

    def play(self, act: Any, key: Key, episodes: int) -> Transition:
        """Real episodes ``[episodes, T]``."""
        steps = self.config.num_steps
        return rollout(self.dyna.env, act, key, self.hparams.env, episodes, num_steps=steps)


@cache
def work(options: DataOptions) -> Work:
    """A run in one unit: ``r2`` ``[source, judge]`` and ``open_loop`` ``[source, HORIZON]``."""
    tuned = changed(
        TUNED, {"episodes": options.episodes, "dyna.model_updates": 0, "dyna.num_real_first": 0}
    ).resolved()
    dyna = parts(tuned)._replace(dream=None, diagnose=None)
    learn = make_train(dyna, tuned.dyna)
    setup = Setup(dyna, replace(tuned.dyna, model_updates=options.updates), tuned.hparams)

    def study(key: Key) -> Metrics:
        key_run, key_play, key_fit, key_test, key_judge = jax.random.split(key, 5)
        state, _ = learn(key_run, setup.hparams)
        policies = [_policy(setup, state.agent, share) for share in JUDGES.values()]
        single = partial(_single, setup, count=options.transitions)
        found = [*map(single, policies, jax.random.split(key_play, 2))]
        found.append(ring.sample_distinct(state.replay, key_test, options.transitions))
        fitted = [*map(partial(_fit, setup), jax.random.split(key_fit, len(SOURCES)), found)]
        return _judge(setup, fitted, policies, key_judge, options.judged_episodes)

    return Work(
        init=lambda key, _: key,
        step=lambda key, _, unit, hparams: (jax.random.clone(key), study(key)),
        piece=1, block=options.block)  # fmt: skip


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
    episodes = setup.play(act, key_play, -(-count // 8))
    example = jax.tree.map(lambda leaf: leaf[0, 0], episodes)
    held = ring.add(ring.init(episodes.mask.size, example), episodes, episodes.mask)
    return ring.sample_distinct(held, key_sample, count)


def _fit(setup: Setup, key: Key, data: Transition) -> Any:
    """The parameters of a model that is trained on the data."""
    dyna, config, hparams = setup
    key_init, key_rows, key_update = jax.random.split(key, 3)
    model = dyna.model.init(key_init, hparams.model)
    held = ring.Replay(data, jnp.int32(len(data.mask)))
    state = DynaState(
        agent=None, model=model, replay=held, starts=None, dreams_safe=jnp.bool_(False), key=key
    )
    return train_model(dyna, config, state, key_rows, key_update, hparams)[0].params


def _judge(setup: Setup, fitted: list, policies: list, key: Key, episodes: int) -> Metrics:
    key_play, key_sums, key_open = jax.random.split(key, 3)
    play = partial(setup.play, episodes=episodes)
    tests = [*map(play, policies, jax.random.split(key_play, len(JUDGES)))]
    models, kinds = (jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
                     for each in (fitted, tests))  # fmt: skip
    predict = setup.dyna.model.predict
    sums_of = jax.vmap(one_step_sums(predict), (None, 0, 0))
    keys = jax.random.split(key_sums, (len(SOURCES), len(JUDGES)))
    sums = jax.vmap(sums_of, (0, None, 0))(models, kinds, keys)
    errors_of = jax.vmap(lambda params, keys: _open_loop_error(predict, params, tests[1], keys))
    errors = errors_of(models, jax.random.split(key_open, (len(SOURCES), episodes)))
    return {"r2": r_squared(sums, "change").mean(-1), "open_loop": errors}


def _open_loop_error(predict: Any, params: Any, episodes: Transition, keys: Key):
    """Root mean square error after each of `HORIZON` dreamed steps, in standard deviations of the
    true state over the episodes, ``[HORIZON]``.
    """
    dream, actions = partial(open_loop, predict, params), episodes.action[:, :HORIZON]
    dreamed = jax.vmap(dream)(episodes.obs[:, 0], actions, keys).next_obs
    valid, count = episodes.mask[..., None], episodes.mask.sum()
    mean = (episodes.obs * valid).sum((0, 1)) / count
    std = jnp.sqrt((jnp.square(episodes.obs - mean) * valid).sum((0, 1)) / count)
    square = jnp.square((dreamed - episodes.next_obs[:, :HORIZON]) / std).mean(-1)
    alive = episodes.mask[:, :HORIZON]
    return jnp.sqrt(jnp.where(alive, square, 0).sum(0) / alive.sum(0))  # NaN where all have ended


def describe(options: DataOptions, curves: Curves) -> tables.Results:
    """``change_r2`` by source and judge, ``open_loop_error`` by source and dreamed step."""
    errors = curves["open_loop"][:, 0][..., np.subtract(SHOWN_STEPS, 1)]

    def by_source(names: Sequence[str], values: Any) -> tables.Results:
        return {source: by_class(names, values[:, row]) for row, source in enumerate(SOURCES)}

    return {
        "change_r2": by_source([*JUDGES], curves["r2"][:, 0]),
        "open_loop_error": by_source([*map(str, SHOWN_STEPS)], errors),
    }


def section(record: Any) -> str:
    """The tables, and ``horizon.png``."""
    said, errors = record.results["arms"][ARM], record.curves[ARM]["open_loop"][:, 0]
    by_source = {source: errors[:, row] for row, source in enumerate(SOURCES)}
    plots.bands(record.out / "horizon.png", {"": by_source}, "dreamed steps",
                "error (standard deviations)", legend="trained on", log=True)  # fmt: skip
    ahead, fed = (
        tables.markdown_table(
            ["trained on", *rows[SOURCES[0]]],
            [[name, *(tables.with_interval(one, 3) for one in row.values())]
             for name, row in rows.items()],
        )
        for rows in (said["change_r2"], said["open_loop_error"]))  # fmt: skip
    return report.paragraphs(
        f"{tables.runs(len(errors))}. In each a policy is trained; the `tuned` preset's model is "
        "then fitted to each kind of transitions, and judged on new episodes of each policy.",
        "## One step ahead",
        "Share of the variance of a step's change that is explained (R², mean of the four state "
        "variables; mean over runs and 95% interval). Columns: who played the episodes that it is "
        "judged on.",
        ahead,
        "## Fed with its own predictions",
        "Root mean square error on episodes of the trained policy, by dreamed step, in standard "
        "deviations of the state.",
        fed, "![error against horizon](horizon.png)")  # fmt: skip


DATA = Experiment(
    name="data",
    title="What data does a CartPole model need?",
    presets={"tuned": DataOptions(seeds=20, episodes=300, block=5)},
    quick={"tuned": {"seeds": 2, "episodes": 100, "updates": 1000}},
    arms=lambda options: {ARM: lambda: Arm(work(options), (), units=1)},
    describe=(describe,),
    sections=(section, report.settings, report.spent),
)
