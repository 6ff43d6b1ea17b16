"""How good a learned CartPole model is, on episodes that it never saw."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.dyna import Dyna, DynaConfig, DynaHParams, Metrics
from jaxdyna.envs import CartPole
from jaxdyna.experiments.report import plots
from jaxdyna.experiments.report.sections import paragraphs
from jaxdyna.experiments.report.summaries import FIRST_DREAMS, Curves
from jaxdyna.experiments.report.tables import Results, markdown_table, number, whole
from jaxdyna.models.evaluation import one_step, one_step_sums, open_loop, r_squared
from jaxdyna.rollout import rollout
from jaxdyna.types import Key, Transition

STATES = ("cart position", "cart velocity", "pole angle", "pole angular velocity")
OUTPUTS = ("position (m)", "velocity (m/s)", "angle (rad)", "ang. velocity", "reward", "p(end)")
SHOWN = {
    "policy": "held-out episode of the trained policy",
    "random": "held-out episode of a random policy",
}
KINDS = ("truth", "one_step", "open_loop")
HELD_OUT_EPISODES = 20
COMMON = {0.0: 134, 0.3: 133, 1.0: 133}  #: transitions by the share of their actions at random
DREAMS = {"fake_length": "fake length", "real_length": "real length", "fake_return": "fake return"}


def judge(dyna: Dyna, config: DynaConfig, state: Any, key: Key, hparams: DynaHParams) -> Metrics:
    """One-step R² on new episodes of the final policy, of the next state ``r2_state`` ``[obs]`` and
    of its change ``r2_change``; nothing without a model.
    """
    if dyna.model is None:
        return {}
    key_play, key_judge = jax.random.split(key)
    real = _play(dyna, config, state, key_play, hparams, HELD_OUT_EPISODES)
    sums = one_step_sums(dyna.model.predict)(state.model.params, real, key_judge)
    return {f"r2_{kind}": r_squared(sums, kind) for kind in ("state", "change")}


def show(dyna: Dyna, config: DynaConfig, state: Any, key: Key, hparams: DynaHParams) -> Metrics:
    """Truth and predictions of one episode of the policy and one of a random policy, each
    ``WHO_truth``, ``WHO_one_step``, ``WHO_open_loop`` ``[T, outputs]`` and ``WHO_length``.
    """
    if dyna.model is None:
        return {}
    predict, params, arrays = dyna.model.predict, state.model.params, {}
    for who, key_episode in zip(SHOWN, jax.random.split(key), strict=True):
        key_play, key_one, key_open = jax.random.split(key_episode, 3)
        real = _play(dyna, config, state, key_play, hparams, 1, at_random=who == "random")
        step = jax.tree.map(lambda leaf: leaf[0], one_step(predict, params, real, key_one))
        free = open_loop(predict, params, real.obs[0, 0], real.action[0], key_open)
        truth = jax.tree.map(lambda leaf: leaf[0], real)
        for kind, said in zip(KINDS, (truth, step, free), strict=True):
            columns = [said.next_obs, said.reward[:, None], said.terminated[:, None]]
            arrays[f"{who}_{kind}"] = jnp.concatenate(columns, axis=1)
        arrays[f"{who}_length"] = real.mask[0].sum()
    return arrays


def _play(dyna, config, state, key, hparams, episodes, at_random=False) -> Transition:
    def act(obs, key):
        if at_random:
            return jax.random.randint(key, (), 0, dyna.env.num_actions)
        return dyna.agent.act(state.agent, obs, key, hparams.agent)

    return rollout(dyna.env, act, key, hparams.env, episodes, num_steps=config.num_steps)


@cache
def common_transitions() -> Transition:
    """The same new transitions for every model, ``[400, 1]``: of a controller that balances the
    pole with none, some and all of its actions at random.
    """
    env = CartPole()

    @jax.jit
    def play(share: float, key: Key) -> Transition:
        def act(obs: jax.Array, key: Key) -> jax.Array:
            key_which, key_random = jax.random.split(key)
            balance = obs @ jnp.array([0.02, 0.05, 1.0, 0.5]) > 0
            at_random = jax.random.bernoulli(key_random)
            return jnp.where(jax.random.bernoulli(key_which, share), at_random, balance).astype(int)

        return rollout(env, act, key, env.default_params, 20)

    def draw(share: float, key: Key, size: int) -> Transition:
        played = jax.tree.map(np.asarray, play(share, key))
        rows = chosen.choice(int(played.mask.sum()), size, replace=False)
        return jax.tree.map(lambda leaf: leaf[played.mask][rows, None], played)

    chosen, keys = np.random.default_rng(0), jax.random.split(jax.random.key(2**20), len(COMMON))
    drawn = map(draw, COMMON, keys, COMMON.values())
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *drawn)


def describe(options: Any, curves: Curves) -> Results:
    """One-step R² per state variable, of the next state and of its change."""
    if "r2_state" not in curves:
        return {}
    return {"model": {
        f"one_step_r2_{kind}": {
            name: {
                "mean": float(one.mean()), "median": float(np.median(one)), "min": float(one.min()),
                "per_seed": one.tolist(),
            }
            for name, one in zip(STATES, curves[f"r2_{kind}"].T, strict=True)
        } for kind in ("state", "change")}}  # fmt: skip


def section(record: Any) -> str:
    """The first dreams of each arm, and the models that are learned; ``fig5_ARM.png``, of what was
    swept the first setting's.
    """
    arms, said = record.results["arms"], []
    if dreams := [
        [name, *(whole(first[key]) for key in DREAMS)]
        for name, arm in arms.items()
        if np.isfinite((first := arm["first_dreams"]).get("fake_length", np.nan))
    ]:
        said = [f"Medians over the first {FIRST_DREAMS} episodes with dreams:",
                markdown_table(["arm", *DREAMS.values()], dreams)]  # fmt: skip
    models = {name: arm["model"] for name, arm in arms.items()
              if "model" in arm and not name.startswith("placebo")}  # fmt: skip
    if models:
        filmed = [name for name in models if "show_policy_truth" in record.curves[name]]
        drawn = {name.partition("@")[0]: name for name in reversed(filmed)}
        rows = [
            [name, state, *(number(model[f"one_step_r2_{kind}"][state][of], 4)
                            for kind in ("state", "change") for of in ("median", "min"))]
            for name, model in models.items() for state in STATES]  # fmt: skip
        header = ["model of", "variable", "next state: median", "worst run", "change: median",
                  "worst run"]  # fmt: skip
        said += [
            "## The models",
            f"One-step R² on {HELD_OUT_EPISODES} new episodes of each run's final policy, none of "
            "them trained on. The next state is easy to explain, because it is close to the state "
            "before; the change of the state is the harder test.",
            markdown_table(header, rows),
            *(_fig5(record, name) for name in reversed(drawn.values())),
            "The dashed line of Fig. 5 goes on from the model's own predictions under the recorded "
            "actions. An unstable pole makes any small error grow there: those actions balanced "
            "the real pole, not the slightly different one that is imagined. A policy that acts in "
            "a dream reacts to what it sees in it.",
        ]
    return paragraphs(*said)


def _fig5(record: Any, name: str) -> str:
    curves, file = record.curves[name], f"fig5_{name}.png".replace("/", "_")
    episodes = {
        title: {kind: curves[f"show_{who}_{kind}"][: int(curves[f"show_{who}_length"])]
                for kind in KINDS}
        for who, title in SHOWN.items()}  # fmt: skip
    plots.prediction_figure(record.out / file, episodes, OUTPUTS)
    return f"![Fig. 5: predictions of the first run's model of {name}]({file})"
