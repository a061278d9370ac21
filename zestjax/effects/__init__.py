"""Only the effects a scene calls for: found in its frames, with evidence, and taken out of the system where not there.

found = effects.inspect(video)
system = effects.system_for(model.system, effects.chosen(found, "auto"))
"""

from zestjax.effects.found import EFFECTS, Evidence, as_told, chosen
from zestjax.effects.inspection import inspect
from zestjax.effects.systems import params_for, priors_for, system_for

__all__ = ["EFFECTS", "Evidence", "as_told", "chosen", "inspect", "params_for", "priors_for", "system_for"]
