"""One discharge of a file, before it is checked."""

from __future__ import annotations

from typing import Any, NamedTuple

from battery_env.records.discharge import LEAST_SAMPLES, Discharge
from battery_env.records.refusals import Advice, Origin, RecordError

# A current without a unit is in A, unless the discharge draws more than this: then it may be in mA.
_MOST_WITHOUT_UNIT_AH = 10.0


class Recording(NamedTuple):
    """One discharge of a file or a table, not checked yet."""

    arrays: dict[str, Any]  # arguments of Discharge, by name
    meta: dict[str, Any]  # other data; without ``cycle`` if the file holds one discharge and does not number it
    origin: Origin

    def discharge(self) -> Discharge:
        """Check the recording; an error has the commands that may mend it."""
        try:
            if (count := len(self.arrays["time_s"])) < LEAST_SAMPLES:
                export = Advice("If each is the end of a step, export all that was recorded")
                raise RecordError(f"{count} rows are no discharge", [export])
            discharge = Discharge(**self.arrays, meta=self.meta)
            drawn_Ah = discharge.charge_C / 3600.0
            if drawn_Ah > _MOST_WITHOUT_UNIT_AH and self.origin.leaves_open("current"):
                raise RecordError(
                    f"the current has no unit, and draws {drawn_Ah:.4g} Ah if it is in A, {drawn_Ah:.4g} mAh if it is in mA: "
                    f"above {_MOST_WITHOUT_UNIT_AH:g} Ah state which",
                    [Advice(f"{unit}? Then", "units", {"current": unit}) for unit in ("mA", "A")],
                )
            return discharge
        except RecordError as error:
            raise error.of(self.origin) from error
