"""Frame models as work, for any world that is seen as frames: training, judging, scores, report.

A model and what it learns from, so many episodes or whose, is an arm, ``NAME@STAGE``. All stages
of a model are one `jaxdyna.experiments.engine.Work` and differ in `worlds.Stage` alone. What a
world fills in is `worlds.World`; a small grid seen from above fills in less, see `grids`.
"""
