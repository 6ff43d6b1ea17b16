"""Every experiment's command line at its smallest.

Tests run some of them in their own process; run as a script this prints those that `.ci/run` starts
as a user does. Where both run the same programs, the second finds them compiled.
"""

import shlex

CARTPOLE = [
    "--seeds", "2", "--episodes", "24", "--real-first", "4", "--model.hidden", "16",
    "--model-updates", "2", "--dream-episodes", "2",
]  # fmt: skip
READINGS = [
    "--seeds", "2", "--episodes", "101",
    "--arms", "model-free, learning rate 0.01", "true environment as the model",
]  # fmt: skip
ACCURACY = [
    "--seeds", "2", "--episodes", "105",
    "--arms", "dyna (paper preset)", "hidden layers of 4", "2 model updates an episode",
]  # fmt: skip
MAZE = [
    "--quick", "--seeds", "2", "--episodes", "52", "--size", "4", "--steps", "8",
    "--real-first", "30", "--model-updates", "1", "--model-batch", "4", "--model-widths", "4",
    "--dream-episodes", "2", "--dream-steps", "3", "--agent.updates", "1",
    "--agent.fake-updates", "1", "--agent.batch", "4",
]  # fmt: skip
MAZE_PLANNED = [
    "--shown-episodes", "2", "--cloning.updates", "2", "--mpc.candidates", "2", "--mpc.horizon", "2"
]  # fmt: skip
MAZE_MODEL = [
    "--part", "model", "--quick", "--seeds", "2", "--episodes", "6", "--stages", "2", "6",
    "--ablation-stage", "6", "--steps", "30", "--horizon", "10", "--held-out", "2",
    "--paper.updates", "3", "--lean.updates", "3", "--widths", "4", "4", "4", "--dense", "16",
    "--lean-widths", "4", "4",
]  # fmt: skip
PLANNING = [
    "--quick", "--seeds", "2", "--episodes", "6", "--grounds", "cartpole",
    "--sizes.runs", "2", "1", "--sizes.cartpole-episodes", "4", "--sizes.played", "1", "1",
    "--sizes.candidates", "4", "--sizes.simulations", "4",
]  # fmt: skip
PONG = [
    "--quick", "--seeds", "1", "--episodes", "21", "--steps", "12", "--real-first", "20",
    "--model-updates", "1", "--model-batch", "2", "--dream-episodes", "2", "--dream-steps", "2",
    "--hidden", "4", "--agent.updates", "1", "--agent.fake-updates", "1", "--agent.batch", "2",
    "--agent.fake-capacity", "16", "--widths", "2", "2", "2", "--dense", "8",
]  # fmt: skip
PONG_MODEL = [
    "--part", "model", "--quick", "--seeds", "1", "--episodes", "2", "--steps", "14",
    "--horizon", "3", "--held-out", "2", "--dreams", "2", "--hidden", "4",
    "--paper.updates", "2", "--paper.batch", "2", "--ours.updates", "2", "--ours.batch", "2",
]  # fmt: skip
ON_THE_ATARI = ["--game", "ale", "--frames", "rgb", "--policies", "mixed"]

SMOKE = {
    "cartpole-paper": ["cartpole", *CARTPOLE, "--arms", "model_free", "dyna"],
    "cartpole-lean": ["cartpole", "--preset", "lean", *CARTPOLE, "--arms", "model_free", "dyna"],
    "maze": ["maze", *MAZE, *MAZE_PLANNED, "--arms", "placebo", "mpc_init"],
    "planning": ["planning", *PLANNING, "--arms", "mpc", "mpc_init"],
    "pong-model": ["pong", *PONG_MODEL, *ON_THE_ATARI, "--arms", "adversarial", "ours"],
    "pong": ["pong", *PONG, "--arms", "dyna_adversarial"],
    "maze-model": ["maze", *MAZE_MODEL, "--arms", "paper", "lean"],
    "accuracy": ["cartpole_accuracy", *ACCURACY],
    "readings": ["cartpole_readings", *READINGS],
    "levers": [
        "cartpole_levers", "--seeds", "2", "--episodes", "10",
        "--arms", "one network, no disagreement",
    ],
}  # fmt: skip

if __name__ == "__main__":
    for name, command in SMOKE.items():
        print(name, shlex.join(command))
