"""The two-phase loop of Fig. 3, and what it is put together from."""

from jaxdyna.dyna.config import DynaConfig, DynaHParams
from jaxdyna.dyna.loop import make_init, make_step, make_train, play_dreams, play_real, train_model
from jaxdyna.dyna.parts import Dream, Dyna, DynaState, Expert, Metrics, survived

__all__ = [
    "Dream", "Dyna", "DynaConfig", "DynaHParams", "DynaState", "Expert", "Metrics", "make_init",
    "make_step", "make_train", "play_dreams", "play_real", "survived", "train_model",
]  # fmt: skip
