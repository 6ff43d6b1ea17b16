"""The tables of learning to act in the Maze."""

from __future__ import annotations

import math

from jaxdyna.experiments.maze_train_options import Options
from jaxdyna.experiments.report import Results, interval, markdown_table
from jaxdyna.experiments.train_cost import cost_said

PAPER_N = 100
CONTROLS = (
    "- Controls: `placebo` dreams in a model that is never trained; `oracle` dreams in the true "
    "maze, from the same frames, as many steps; `more_updates` makes as many updates as `dyna`, "
    "all of them on real transitions."
)
Table = tuple[list[str], list[list[str]]]


def method(options: Options) -> str:
    """What the arms do, as a list."""
    agent, hparams = options.agent, options.hparams.agent
    rare = (
        "as they come"
        if options.rare_share is None
        else f"at least {options.rare_share / 2:.1%} of each collisions and as much goal steps"
    )
    model = {
        "local": f"3x3 convolutions of {options.model_widths} channels",
        "paper": "the paper's Fig. 4",
    }[options.model]
    doubt = options.hparams.disagreement_threshold
    cut = f", broken off where the model expects more than {doubt:g} wrong pixels"
    cut = cut if doubt < math.inf else ""
    network = {
        "convolutions": f"convolutions of {options.convolutions} channels (of 2x2 cells at a "
        f"stride of 2, then of 3x3) and a dense layer of {options.dense}",
        "glimpse": "heads that each begin at one colour of the newest frame, its mean place and "
        "what is around it (a glimpse), and a perceptron",
    }[options.network]
    acting = ", by which it acts" if agent.act_by_target else ""
    until = " and until the goal has been met once" if agent.explore_until_rewarded else ""
    return "\n".join(
        [
            f"- Maze: {options.size}x{options.size} cells, {options.obstacles} obstacles, "
            f"{options.steps} steps; a collision {options.hparams.env.collision_reward:+g}, a step "
            f"on the goal {options.hparams.env.goal_reward:+g}.",
            f"- Agent, in all arms: {'Double ' if agent.double else ''}DQN on four stacked frames, "
            f"{network}; {agent.n_step}-step targets, discount {hparams.discount:g}, Adam at "
            f"{hparams.learning_rate:g}, batches of {agent.batch} drawn by priority with an "
            f"exponent of {hparams.priority_exponent:g}, a target network that moves by "
            f"{hparams.target_rate:g} of the difference{acting}. {agent.updates} updates after a "
            "real episode.",
            f"- Exploration, in all arms: {hparams.epsilon_first:.0%} of the actions are random "
            f"for {hparams.epsilon_hold:g} episodes{until}, {hparams.epsilon_last:.0%} after "
            f"{hparams.epsilon_episodes:g} more. Each episode's random actions have odds of their "
            f"own (normal log odds, standard deviation {agent.drift:g}): that gives a direction.",
            f"- Model: {model}, loss {options.model_loss}; after every real "
            f"episode {options.model_updates} updates on batches of {options.model_batch}, {rare}.",
            f"- Dreams: from real episode {options.real_first} on, after each, "
            f"{options.dream_updates} x {options.dream_episodes} of {options.dream_steps} steps, "
            f"each from any real stack of frames{cut}, {hparams.epsilon_fake:.0%} of their actions "
            f"random; then {agent.fake_updates} updates on batches of which "
            f"{hparams.fake_share:.0%} is dreamed. Once there are dreams, the updates after a real "
            f"episode draw them as well. The newest {agent.fake_capacity:,} dreamed steps, also of "
            f"earlier models, and the newest {agent.capacity:,} real ones are kept.",
            CONTROLS,
            *_planners(options),
            f"- Not the paper's, or not said there: {_differences(options)}.",
        ]
    )


def _planners(options: Options) -> list[str]:
    """How the planner arms decide, where there are any."""
    lines, mpc, mcts = [], options.mpc, options.mcts
    shoots = f"{mpc.candidates} sequences of {mpc.horizon} steps in the model"
    if {"mpc", "mpc_init"} & set(options.arms):
        lines.append(
            f"- `mpc`: from real episode {options.real_first + 1} on a decision is the first of "
            f"the best of {shoots}, the agent's values for what comes after them. No dreams."
        )
    if "mcts" in options.arms:
        lines.append(
            f"- `mcts`: likewise a tree of {mcts.simulations} nodes (MuZero's search), the agent's "
            "values at its leaves and for its prior's log odds. No dreams."
        )
    if "mpc_init" in options.arms:
        lines.append(
            f"- `mpc_init`: `mpc` plays {options.shown_episodes} episodes, which the agent learns "
            f"from and imitates ({options.cloning.updates} updates after each, a margin loss); it "
            "goes on model-free. No dreams."
        )
    return lines


def _differences(options: Options) -> str:
    agent, hparams = options.agent, options.hparams.agent
    said = {
        "Double DQN": agent.double,
        "dueling values and Huber's loss": True,
        f"draws by priority (importance exponent {hparams.importance_exponent:g})": (
            hparams.priority_exponent > 0
        ),
        "acting by the averaged network": agent.act_by_target,
        "dense layers that are normalised": True,
        "glimpses instead of convolutions, the first heads on the colours": (
            options.network == "glimpse"
        ),
        f"a discount of {hparams.discount:g} (the authors' code has 1)": hparams.discount < 1,
        "directed exploration": agent.drift > 0,
        "exploring until a reward": agent.explore_until_rewarded,
        "no exploring in the end": hparams.epsilon_last == 0,
        "the number of updates (the authors' code makes one a real step)": True,
        "several short dreams after each real episode, which begin at replayed frames": True,
        "a model of local convolutions instead of Fig. 4, its pixels lit from 0.5 on (the "
        "paper's from 0.2)": options.model == "local",
        "rewards read off the predicted picture as a sum over its cells": True,
        "rare steps drawn more often for the model": options.rare_share is not None,
        f"N = {options.real_first} (the paper's is {PAPER_N})": options.real_first != PAPER_N,
    }
    return "; ".join(text for text, applies in said.items() if applies)


def greedy(results: Results) -> Table:
    """How good the final policies are."""
    rows = []
    for name, arm in results["arms"].items():
        share, hits = arm["greedy"]["share"], arm["greedy"]["collisions"]
        rows.append(
            [
                name,
                f"{arm['episodes_played']}",
                f"{share['mean']:.3f} ({interval(share['ci95'], 3)})",
                f"{hits['mean']:.2f} ({interval(hits['ci95'], 2)})",
            ]
        )
    return ["arm", "real episodes played", "share of the oracle's return", "collisions"], rows


def model(results: Results) -> list[str]:
    """How wrong the learned models are on real episodes that are new to them: a table, if any."""
    rows = [
        [name, *(f"{arm['model'][wrong][when]:.2%}" for when in ("first_dreams", "last")
                 for wrong in ("wrong_frames", "wrong_rewards"))]
        for name, arm in results["arms"].items()
        if arm["model"]
    ]  # fmt: skip
    header = ["model of", "frames wrong: first ten episodes with dreams", "rewards wrong"]
    header += ["frames wrong: last ten episodes", "rewards wrong"]
    return [markdown_table(header, rows)] if rows else []


def time(results: Results) -> Table:
    """Seconds of each arm, and of all."""
    timing = results["timing"]
    rest = timing["total_s"] - timing["compile_s"] - timing["run_s"]
    rows = [
        [name, f"{arm['compile_s']:.0f}", f"{arm['run_s']:.0f}"]
        for name, arm in timing["arms"].items()
    ]
    rows.append(["judging, measuring, drawing", "", f"{rest:.0f}"])
    rows.append(["all", "", f"{timing['total_s']:.0f}"])
    cores = results["device"]["cpu_cores"]
    return [f"arm ({cores} cores)", "compiling (s)", "running (s)"], rows


def cost(results: Results) -> list[str]:
    """Where the time goes, and the most memory that was taken: paragraphs."""
    peak = results["device"]["peak_memory_gib"]
    paragraphs = cost_said(results)
    if peak is not None:
        paragraphs.append(
            f"The process took {peak:.1f} GiB of memory at the most, for "
            f"{results['config']['seeds']} runs of an arm at a time."
        )
    return paragraphs
