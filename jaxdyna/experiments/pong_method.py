"""How the arms of learning to play Pong were made, in words."""

from __future__ import annotations

from dataclasses import fields

from jaxdyna.envs import PongParams
from jaxdyna.experiments.pong_train_options import Options
from jaxdyna.experiments.pong_train_parts import MENDED, NEED_STATE, world_of

SEEN_SAID = {
    "objects": "the field, each object in a channel of its own",
    "rgb": "the field in the game's colours",
    "grey": "the whole screen in grey",
}
FROM_FIG4 = {"dyna_l2", "dyna_adversarial", *MENDED}
FROM_OURS = {"dyna", "placebo"}


def method(options: Options) -> str:
    """A list of what was set, as far as the arms that were played need it."""
    arms = set(options.arms)
    parts = [_frames(options), _agent(options), _exploration(options)]
    if arms & (FROM_FIG4 | FROM_OURS):
        parts.append(_models(options))
    if "more_updates" in arms:
        agent = options.agent
        parts.append(f"`more_updates`: {agent.updates + agent.fake_updates} updates after each "
                     "real episode, on real steps alone.")  # fmt: skip
    if arms - {"model_free", "more_updates"}:
        parts.append(_dreams(options))
    if "placebo" in arms:
        parts.append("`placebo` dreams in our model, never trained.")
    if arms & set(NEED_STATE):
        parts.append(
            "A dream with the true game beside it begins at a state read off the same frames; what "
            "they cannot tell is drawn. `oracle` sees all of the true game and its rewards; "
            "`true_...` one object of it, or all its frames, and the model's rewards."
        )
    return "\n".join(f"- {part}" for part in parts)


def _frames(options: Options) -> str:
    height, width, _ = world_of(options).frame_shape
    said = f"Frames of {height}x{width}: {SEEN_SAID[options.frames]}"
    if options.game == "ale":
        return f"{said}{'' if options.frames == 'grey' else ', objects told by their colours'}."
    return (
        f"{said}; a ball is served {options.serve_delay} of the game's frames after a point (63 in "
        f"the real game).{_otherwise(options)}"
    )


def _otherwise(options: Options) -> str:
    """What of the pure game was set otherwise than in the original."""
    default = PongParams()
    given = {field.name: getattr(options.hparams.env, field.name) for field in fields(default)}
    changed = [
        f"{name.replace('_', ' ')} {value:g}"
        for name, value in given.items()
        if value != getattr(default, name)
    ]
    return f" Otherwise than in the original: {', '.join(changed)}." if changed else ""


def _agent(options: Options) -> str:
    agent, hparams = options.agent, options.hparams.agent
    sees = {
        "places": "where each object is and how it moves",
        "glimpses": f"glimpses of {options.glimpse}x{options.glimpse}",
        "convolutions": "three convolutions and a dense layer",
    }[options.look]
    return (
        f"Agent, in all arms: {'Double ' if agent.double else ''}DQN on four stacked frames by "
        f"{sees}, {agent.n_step}-step targets, discount {hparams.discount:g}, Adam at "
        f"{hparams.learning_rate:g}, batches of {agent.batch} drawn by priority with an exponent "
        f"of {hparams.priority_exponent:g}; {agent.updates} updates after a real episode."
    )


def _exploration(options: Options) -> str:
    hparams = options.hparams.agent
    return (
        f"Exploration, in all arms: {hparams.epsilon_first:.0%} of the actions are random for "
        f"{hparams.epsilon_hold:g} episodes, {hparams.epsilon_last:.0%} after "
        f"{hparams.epsilon_episodes:g} more."
    )


def _models(options: Options) -> str:
    arms, rare, rate = set(options.arms), options.rare_share, options.hparams.model.learning_rate
    often = "" if rare is None else f", at least {rare:.0%} of them points won and lost"
    said = (
        f"Models: {options.model_updates} updates after each real episode on batches of "
        f"{options.model_batch}{often}."
    )
    if arms & FROM_OURS:
        said += (
            f" `dyna`: categories for the places of each object's edges, dropout "
            f"{options.dropout:g}, weight decay {options.weight_decay:g}, learning rate {rate:g}, "
            "drawn in dreams."
        )
    if arms & FROM_FIG4:
        said += (
            " `dyna_l2`: Fig. 4 on patches, squared error, in shades, the reward read off its "
            f"joint features, learning rate {options.paper_rate:g}."
        )
    if "dyna_adversarial" in arms:
        said += (
            f" `dyna_adversarial`: with the adversarial loss beside it, lambda "
            f"{options.adversarial_weight:g}, the discriminator at the same rate."
        )
    return said


def _dreams(options: Options) -> str:
    agent, hparams = options.agent, options.hparams.agent
    return (
        f"Dreams: from real episode {options.real_first} on, after each, {options.dream_episodes} "
        f"of {options.dream_steps} steps from any real stack of frames, "
        f"{hparams.epsilon_fake:.0%} of their actions random; then {agent.fake_updates} updates. "
        f"From then on {hparams.fake_share:.0%} of every batch of the agent's is dreamed."
    )
