"""Somebody else's modern agent on CartPole: DreamerV3 (Hafner et al. 2025) as ajax-rl has it.

It needs an environment of its own: Python 3.12 with ``pip install ajax-rl==0.4.0``, which takes
another JAX than this package (recorded with jax 0.11.2, flax 0.12.12, gymnax 1.0.1). Then

    python docs/examples/modern_agent.py --seeds 6 --out experiments/modern_agent/returns.csv

plays CartPole-v1 with v0's 200 steps and writes what the policy as it stands after every 100 rows
of the replay earns on average in 100 new episodes, and a report beside it. Runs that the file holds
already are not made again; each takes some twelve minutes of a core that has nothing else to do.
"""

import argparse
import csv
import time
from pathlib import Path
from unittest.mock import patch

import gymnax
import jax.numpy as jnp
import numpy as np
from ajax import DreamerV3
from ajax.agents.DreamerV3 import train_DreamerV3
from ajax.extensions.base import Extension
from ajax.logging.wandb_logging import LoggingConfig

SETTINGS = {
    "model_size": "1m", "n_envs": 1, "train_ratio": 128, "batch_size": 8, "batch_length": 32,
    "learning_rate": 3e-4,
}  # fmt: skip
"""The smallest networks that its authors name; whatever is not said here is theirs too."""
EPISODES, ENOUGH = 100, 195.0
"""Of an evaluation, and the mean return that is asked for."""
COLUMNS = ("seed", "real_steps", "updates", "greedy_return", "sampled_return", "run_seconds")


class Greedy(Extension):
    """Judges the most likely actions too: the authors draw actions in evaluations as well."""

    name = "greedy"
    agent: DreamerV3

    def eval_metrics(self, agent_state, ext_state, rng, ctx):
        """Without noise an action is the most likely one; the latent state is drawn still."""
        del ext_state, ctx
        args = self.agent.env_args

        def silent(key, shape, discrete):
            return jnp.zeros(shape)

        with patch.object(train_DreamerV3, "draw_action_noise", silent):
            judged = train_DreamerV3.evaluate_dreamer(
                agent_state, rng, env_args=args, config=self.agent.dreamer_config,
                spec=train_DreamerV3.env_spec(args), num_episode_test=EPISODES,
            )  # fmt: skip
        steps = agent_state.collector_state.env_steps  # a row of the replay may be none: an end is
        return {"real_steps": steps, "greedy_return": judged["Eval/episodic mean reward"]}


def run(seed: int, rows: int, every: int) -> list[dict[str, float]]:
    """A run's evaluations, by `COLUMNS`."""
    params = gymnax.make("CartPole-v1")[1]
    judge = Greedy()
    judge.agent = agent = DreamerV3(
        "CartPole-v1", env_params=params.replace(max_steps_in_episode=200), extensions=(judge,),
        **SETTINGS,
    )  # fmt: skip
    began = time.perf_counter()
    evaluating = LoggingConfig({}, log_frequency=every, use_wandb=False)
    _, logged = agent.train(seed, rows, EPISODES, evaluating)
    seconds = round(time.perf_counter() - began, 1)
    told = {name: np.asarray(values).reshape(-1) for name, values in logged.items()}
    return [
        {
            "seed": seed,
            "real_steps": int(told["real_steps"][i]),
            "updates": int(told["Train/n_updates"][i]),
            "greedy_return": round(float(told["greedy_return"][i]), 2),
            "sampled_return": round(float(told["Eval/episodic mean reward"][i]), 2),
            "run_seconds": seconds,
        }
        for i in np.flatnonzero(told["timestep"] > 0)
    ]


def report(rows: list[dict[str, str]]) -> str:
    """Of all runs, in Markdown, by `COLUMNS`."""
    lines = [
        "# DreamerV3 on CartPole, as context",
        f"`docs/examples/modern_agent.py` with {SETTINGS}; CartPole-v1 cut at 200 steps. Real "
        f"steps until the policy as it stands first earns {ENOUGH:g} on average in {EPISODES} new "
        "episodes, looked at every so often (a dash: never), and what the last one earns.",
        "| run | until greedy | until drawn | last: greedy | drawn | seconds |\n"
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for seed in sorted({int(row["seed"]) for row in rows}):
        mine = [row for row in rows if int(row["seed"]) == seed]
        first = [
            next((row["real_steps"] for row in mine if float(row[name]) >= ENOUGH), "-")
            for name in ("greedy_return", "sampled_return")
        ]
        last = mine[-1]
        told = [seed, *first, last["greedy_return"], last["sampled_return"]]
        lines[-1] += f"\n| {' | '.join(map(str, told))} | {last['run_seconds']} |"
    return "\n\n".join(lines) + "\n"


def main() -> None:
    """The command line."""
    said = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    said.add_argument("--seeds", type=int, default=6)
    said.add_argument("--rows", type=int, default=2200, help="of the replay, in a run")
    said.add_argument("--every", type=int, default=100, help="so many rows an evaluation")
    said.add_argument("--out", type=Path, required=True)
    told = said.parse_args()
    made = set()
    if told.out.exists():
        made = {int(row["seed"]) for row in csv.DictReader(told.out.open())}
    else:
        told.out.write_text(",".join(COLUMNS) + "\n")
    for seed in sorted(set(range(told.seeds)) - made):
        rows = run(seed, told.rows, told.every)
        with told.out.open("a", newline="") as file:
            csv.DictWriter(file, COLUMNS, lineterminator="\n").writerows(rows)
    rows = list(csv.DictReader(told.out.open()))
    told.out.with_name("report.md").write_text(report(rows))


if __name__ == "__main__":
    main()
