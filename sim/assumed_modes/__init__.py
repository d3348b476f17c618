"""The second plant: assumed modes, exact steps and a causal loss, with physics concealed in it.

It shares no code with the first (`sim.concealed`) and none with the models that the product fits.
`docs/evidence/second-plant.md` has its formulas.
"""

from sim.assumed_modes.trial import make

__all__ = ["make"]
