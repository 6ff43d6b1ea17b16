"""Stable-Baselines3 in this package's worlds: its DQN in a small Maze, its PPO in dreams.

    python docs/examples/stable_baselines.py maze --steps 50000 --seed 1 2 3 4 5

says what its DQN earns there beside the best that there is, which value iteration finds, and

    python -m jaxdyna.experiments.cartpole --preset lean --arms dyna --episodes 10 --seeds 6
    python docs/examples/stable_baselines.py dream --steps 30000 --seed 1 2 3 4 5

what its PPO earns in Gymnasium's CartPole after as many steps in the dream that the run of this
seed has left, or in CartPole itself. It needs ``pip install stable-baselines3``; before that
PyTorch, the build for CPUs.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.evaluation import evaluate_policy

import jaxdyna
from jaxdyna.envs import FrameStack, Maze, MazeParams
from jaxdyna.planners import solve_maze

EPISODES = 100
"""In which what was learned is judged."""
MAZE, PARAMS = Maze(size=5, num_obstacles=2), MazeParams(max_steps=30)
BOARD = FrameStack(MAZE, 2)
"""Two frames show where obstacles go."""
STRAIGHT = [2] * 4 + [1] * 4 + [4] * 22
"""Up, right, and wait at the goal, with closed eyes."""


def maze(steps: int, seed: int) -> dict[str, float]:
    """Mean returns on new boards: of a DQN before and after so many steps, of going straight to the
    goal, and the optimum of these boards.
    """
    env = gymnasium.make("jaxdyna/Maze-v0", env=BOARD, params=PARAMS, max_episode_steps=30)
    model = DQN(
        "MlpPolicy", env, gamma=0.9, learning_rate=1e-3, buffer_size=steps, learning_starts=1000,
        target_update_interval=500, exploration_fraction=0.5,
        policy_kwargs={"net_arch": [256, 256]}, seed=seed, device="cpu",
    )  # fmt: skip
    keys = jax.random.split(jax.random.key(seed), EPISODES)
    start = jax.vmap(BOARD.reset, (0, None))(keys, PARAMS)
    best = jax.vmap(lambda state: solve_maze(MAZE, state.env, PARAMS, 30).best_return)(start[1])

    def greedy(obs: np.ndarray, time: int) -> np.ndarray:
        return model.predict(obs, deterministic=True)[0]

    told = {"untrained": played(start, greedy)}
    model.learn(steps)
    return told | {
        "learned": played(start, greedy),
        "straight on": played(start, lambda obs, time: np.full(EPISODES, STRAIGHT[time])),
        "optimum": float(best.mean()),
    }


def played(start: tuple, act: Callable[[np.ndarray, int], np.ndarray]) -> float:
    """The mean return from these ``(obs, state) [boards, ...]``, played side by side."""
    (obs, state), total = start, 0.0
    for time in range(30):
        obs, state, reward, *_ = step(state, jnp.asarray(act(np.array(obs), time)))
        total += float(reward.mean())
    return total


@jax.jit
def step(state: Any, action: jax.Array) -> tuple:
    """Of all boards at a time; nothing is drawn in a step of the Maze."""
    return jax.vmap(BOARD.step, (None, 0, 0, None))(jax.random.key(0), state, action, PARAMS)


def dream(steps: int, seed: int, run: Path) -> dict[str, float]:
    """Mean returns in CartPole: of a PPO before and after so many steps in a dream, and of one
    after as many there; and the real steps from which the dream was learned.
    """
    left = jaxdyna.load(run)
    left.register(f"Dream{seed}-v0", "dyna", seed)
    real_steps = left.curves["dyna"]["real_length"][left.results["runs"]["seeds"].index(seed)]
    true = gymnasium.make("CartPole-v1", max_episode_steps=200)
    dreamer, other = (
        PPO("MlpPolicy", env, seed=seed, device="cpu")
        for env in (gymnasium.make(f"Dream{seed}-v0"), true)
    )

    def earned(model: PPO) -> float:
        """Of the most likely actions, in the same episodes for each."""
        true.reset(seed=1000 + seed)
        return float(evaluate_policy(model, true, EPISODES, warn=False)[0])

    return {
        "untrained": earned(dreamer),
        "learned in the dream": earned(dreamer.learn(steps)),
        "learned in CartPole": earned(other.learn(steps)),
        "real steps behind the dream": float(np.nansum(real_steps)),
    }


def main() -> None:
    """Prints a line a seed."""
    said = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    said.add_argument("what", choices=["maze", "dream"])
    said.add_argument("--steps", type=int, default=50_000, help="for which each learns")
    said.add_argument("--seed", type=int, nargs="+", default=[0])
    said.add_argument("--run", type=Path, default="runs/cartpole-lean", help="that has left dreams")
    told = said.parse_args()
    for seed in told.seed:
        at = told.steps, seed
        row = maze(*at) if told.what == "maze" else dream(*at, told.run)
        words = ", ".join(f"{name} {value:.1f}" for name, value in row.items())
        print(f"seed {seed}: {words}", flush=True)


if __name__ == "__main__":
    main()
