"""CartPole: REINFORCE with and without a learned model (§4.1, Figs. 5 and 6, Table 2)."""

from jaxdyna.experiments.cartpole.acting import CARTPOLE
from jaxdyna.experiments.cartpole.data import DATA
from jaxdyna.experiments.cartpole.studies import ACCURACY, BASELINES, DYNA_GRID, LEVERS, READINGS

PARTS = (CARTPOLE, READINGS, LEVERS, ACCURACY, DATA, BASELINES, DYNA_GRID)
