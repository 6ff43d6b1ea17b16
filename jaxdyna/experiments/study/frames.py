"""Where these were, before `jaxdyna.dyna.frames` had them."""

from jaxdyna.dyna.frames import frame_dyna, true_dyna

__all__ = ["frame_dyna", "true_dyna"]
