"""How good a learned CartPole model is, on episodes that it never saw."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyna.experiments.report import Results, markdown_table
from jaxdyna.experiments.run import Arm, ArmRun, first_run
from jaxdyna.models.evaluation import Predict, one_step, one_step_sums, open_loop
from jaxdyna.rollout import rollout
from jaxdyna.statistics import r_squared

STATES = ("cart position", "cart velocity", "pole angle", "pole angular velocity")
OUTPUTS = ("position (m)", "velocity (m/s)", "angle (rad)", "ang. velocity", "reward", "p(end)")
HELD_OUT_EPISODES = 20

Curves = dict[str, np.ndarray]


def judge(arm: Arm, run: ArmRun, key: jax.Array) -> Curves:
    """Sums over new episodes played by each seed's final policy (``held_out_*``, ``[seeds, ...]``)
    and two example episodes of the first seed (``example_*``).
    """
    predict = arm.dyna.model.predict if arm.dyna.model else None
    if predict is None:
        return {}
    seeds = run.metrics["real_return"].shape[0]
    judged = jax.jit(jax.vmap(lambda state, key: _judge(arm, predict, state, key)))(
        run.state, jax.random.split(jax.random.fold_in(key, 0), seeds)
    )
    first = first_run(run.state)
    shown = jax.jit(lambda state, key: _example(arm, predict, state, key))(
        first, jax.random.fold_in(key, 1)
    )
    return jax.tree.map(
        np.asarray, {f"held_out_{name}": values for name, values in judged.items()} | shown
    )


def describe(curves: Curves) -> Results:
    """One-step R² per state variable, of the next state and of its change."""
    if "held_out_count" not in curves:
        return {}
    held = {name.removeprefix("held_out_"): values for name, values in curves.items()}
    model = {}
    for kind in ("state", "change"):
        per_seed = r_squared(
            held["state_error"], held[f"{kind}_sum"], held[f"{kind}_square"], held["count"]
        )
        model[f"one_step_r2_{kind}"] = {
            name: {
                "mean": float(values.mean()),
                "min": float(values.min()),
                "per_seed": values.tolist(),
            }
            for name, values in zip(STATES, per_seed.T, strict=True)
        }
    return {"model": model | {"held_out_transitions": int(held["count"].sum())}}


def markdown(name: str, arm: Results) -> list[str]:
    """The report's section on the model of an arm."""
    rows = []
    for state in STATES:
        values = [arm["model"][f"one_step_r2_{kind}"][state] for kind in ("state", "change")]
        rows.append([state, *(f"{v[part]:.4f}" for v in values for part in ("mean", "min"))])
    return [
        f"## The model of `{name}`",
        f"One-step R² on {HELD_OUT_EPISODES} new episodes of each run's final policy "
        f"({arm['model']['held_out_transitions']:,} transitions, none of them trained on). "
        "The next state is easy to explain, because it is close to the state before; the "
        "change of the state is the harder test.",
        markdown_table(
            ["variable", "next state: mean", "worst seed", "change: mean", "worst seed"], rows
        ),
        f"![Fig. 5: predictions of the first seed's model](fig5_{name}.png)",
        "The dashed line goes on from the model's own predictions under the recorded actions. An "
        "unstable pole makes any small error grow there: those actions balanced the real pole, "
        "not the slightly different one that is imagined. A policy that acts in a dream reacts to "
        "what it sees in it.",
    ]


def trimmed(curves: Curves, who: str) -> Curves:
    """An example episode's ``truth``, ``one_step`` and ``open_loop``, up to its end."""
    length = int(curves[f"example_{who}_length"])
    kinds = ("truth", "one_step", "open_loop")
    return {kind: curves[f"example_{who}_{kind}"][:length] for kind in kinds}


def _judge(arm: Arm, predict: Predict, state: Any, key: jax.Array) -> dict[str, jax.Array]:
    key_play, key_judge = jax.random.split(key)
    real = _play(arm, state, key_play, HELD_OUT_EPISODES)
    return one_step_sums(predict)(state.model.params, real, key_judge)


def _example(arm: Arm, predict: Predict, state: Any, key: jax.Array) -> dict[str, jax.Array]:
    """Truth and predictions of one episode of the policy and one of a random policy."""
    arrays = {}
    for name, key_episode in zip(("policy", "random"), jax.random.split(key), strict=True):
        key_play, key_one, key_open = jax.random.split(key_episode, 3)
        real = _play(arm, state, key_play, 1, at_random=name == "random")
        params = state.model.params
        step = jax.tree.map(lambda leaf: leaf[0], one_step(predict, params, real, key_one))
        free = open_loop(predict, params, real.obs[0, 0], real.action[0], key_open)
        truth = (real.next_obs[0], real.reward[0], real.terminated[0])
        arrays[f"example_{name}_truth"] = _columns(*truth)
        arrays[f"example_{name}_one_step"] = _columns(step.next_obs, step.reward, step.terminated)
        arrays[f"example_{name}_open_loop"] = _columns(free.next_obs, free.reward, free.terminated)
        arrays[f"example_{name}_length"] = real.mask[0].sum()
    return arrays


def _play(arm: Arm, state: Any, key: jax.Array, episodes: int, at_random: bool = False):
    def act(obs, key):
        if at_random:
            return jax.random.randint(key, (), 0, arm.dyna.env.num_actions)
        return arm.dyna.agent.act(state.agent, obs, key, arm.hparams.agent)

    return rollout(
        arm.dyna.env, act, key, arm.hparams.env, episodes, num_steps=arm.config.num_steps
    )


def _columns(next_obs: jax.Array, reward: jax.Array, terminated: jax.Array) -> jax.Array:
    return jnp.concatenate([next_obs, reward[:, None], terminated[:, None]], axis=1)
