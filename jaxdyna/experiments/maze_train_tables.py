"""The tables of learning to act in the Maze."""

from __future__ import annotations

import math

from jaxdyna.experiments.maze_train_cost import PARTS
from jaxdyna.experiments.maze_train_options import Options
from jaxdyna.experiments.report import Results, interval, markdown_table

PAPER_N = 100
CONTROLS = (
    "- Controls: `placebo` dreams in a model that is never trained; `oracle` dreams whole episodes "
    "in the true maze, about as many steps; `more_updates` makes as many updates as `dyna`, all of "
    "them on real transitions."
)
Table = tuple[list[str], list[list[str]]]


def method(options: Options) -> str:
    """What the arms do, as a list."""
    agent, hparams = options.agent, options.hparams.agent
    rare = (
        "as they come"
        if options.rare_share is None
        else (f"collisions and goal steps at least {options.rare_share / 2:g} of them each")
    )
    model = {
        "local": f"3x3 convolutions of {options.model_widths} channels",
        "paper": "the paper's Fig. 4",
    }[options.model]
    doubt = options.hparams.disagreement_threshold
    cut = (
        f", broken off where the model expects more than {doubt:g} wrong pixels"
        if doubt < math.inf
        else ""
    )
    network = {
        "convolutions": f"convolutions of {options.convolutions} channels (of 2x2 cells at a "
        f"stride of 2, then of 3x3) and a dense layer of {options.dense}",
        "glimpse": "heads that each begin at one colour of the newest frame, its mean place and "
        "what is around it (a glimpse), and a perceptron",
    }[options.network]
    until = " and until the goal has been met once" if agent.explore_until_rewarded else ""
    return "\n".join(
        [
            f"- Maze: {options.size}x{options.size} cells, {options.obstacles} obstacles, "
            f"{options.steps} steps; a collision {options.hparams.env.collision_reward:+g}, a step "
            f"on the goal {options.hparams.env.goal_reward:+g}.",
            f"- Agent, in all arms: {'Double ' if agent.double else ''}DQN on four stacked frames, "
            f"{network}; {agent.n_step}-step targets, discount {hparams.discount:g}, Adam at "
            f"{hparams.learning_rate:g}, batches of {agent.batch}, prioritised to the power of "
            f"{hparams.priority_exponent:g}, a target network that follows by "
            f"{hparams.target_rate:g}{' and acts' if agent.act_by_target else ''}. "
            f"{agent.updates} updates after a real episode.",
            f"- Exploration, in all arms: a share {hparams.epsilon_first:g} of random actions for "
            f"{hparams.epsilon_hold:g} episodes{until}, which falls to {hparams.epsilon_last:g} in "
            f"{hparams.epsilon_episodes:g} more; what is random leans to directions that are drawn "
            f"for each episode (log odds of {agent.drift:g} standard deviation(s)).",
            f"- Model: {model}, loss {options.model_loss}; after every real "
            f"episode {options.model_updates} updates on batches of {options.model_batch}, {rare}.",
            f"- Dreams: from real episode {options.real_first} on, after each, "
            f"{options.dream_updates} x {options.dream_episodes} of {options.dream_steps} steps, "
            f"each from any real stack of frames{cut}, a share "
            f"{hparams.epsilon_fake:g} of their actions random; then {agent.fake_updates} updates, "
            f"a share {hparams.fake_share:g} of each batch dreamed. Once there are dreams, the "
            "updates after a real episode draw them as well.",
            CONTROLS,
            f"- Not the paper's, or not said there: {_differences(options)}.",
        ]
    )


def _differences(options: Options) -> str:
    said = [
        "Double DQN with dueling values, Huber's loss, draws by priority with an importance "
        f"exponent of {options.hparams.agent.importance_exponent:g}, and acting by the averaged "
        "network",
        "directed exploration",
        "the number of updates (the authors' code makes one a real step)",
        "several short dreams after each real episode, which begin at replayed frames",
    ]
    if options.model == "local":
        said.append("a model of local convolutions instead of Fig. 4")
    if options.network == "glimpse":
        said.append("glimpses instead of convolutions")
    if options.real_first != PAPER_N:
        said.append(f"N = {options.real_first} (the paper's is {PAPER_N})")
    return "; ".join(said)


def greedy(results: Results) -> Table:
    """How good the final policies are."""
    rows = []
    for name, arm in results["arms"].items():
        share, hits = arm["greedy"]["share"], arm["greedy"]["collisions"]
        rows.append(
            [
                name,
                f"{share['mean']:.3f} ({interval(share['ci95'], 3)})",
                f"{hits['mean']:.2f} ({interval(hits['ci95'], 2)})",
            ]
        )
    return ["arm", "share of the oracle's return", "collisions"], rows


def time(results: Results) -> Table:
    """Seconds of each arm."""
    rows = [
        [name, f"{arm['compile_s']:.0f}", f"{arm['run_s']:.0f}"]
        for name, arm in results["timing"]["arms"].items()
    ]
    cores = results["device"]["cpu_cores"]
    return [f"arm ({cores} cores)", "compiling (s)", "running (s)"], rows


def cost(results: Results) -> list[str]:
    """Where the time goes, and the most memory that was taken: paragraphs."""
    rows, rate = [], 0.0
    for name, arm in results["arms"].items():
        seconds, floors = arm["cost"]["seconds"], arm["cost"]["floor_seconds"]
        total, rate = sum(seconds.values()), arm["cost"]["matrix_product_gflops"]
        for part in PARTS:
            if seconds[part]:
                row = [name, part, f"{1e3 * seconds[part]:.0f}", f"{seconds[part] / total:.0%}"]
                rows.append([*row, f"{1e3 * floors[part]:.0f}"])
    peak = results["device"]["peak_memory_gib"]
    paragraphs = [
        "What a real episode takes once there are dreams, one run alone on the machine; the floor "
        "is the floating-point operations over the rate of a large matrix product "
        f"({rate:.0f} GFLOP/s here).",
        markdown_table(["arm", "part", "ms", "share", "floor (ms)"], rows),
    ]
    if peak is not None:
        paragraphs.append(f"The process took {peak:.1f} GiB of memory at the most.")
    return paragraphs
