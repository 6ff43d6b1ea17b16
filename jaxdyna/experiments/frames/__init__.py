"""Frame models as work, for any world that is seen as frames (`worlds.World`), and with less to
fill in for small `grids`. An arm is ``NAME@STAGE``: all stages of a model, so many episodes or
whose, are one `jaxdyna.experiments.engine.Work` and differ in `worlds.Stage` alone.
"""
