"""How long a real cell still lasts under pulses, with the q_max that its earlier discharges let expect."""

import numpy as np

from battery_env import Settings, load_nasa_discharges, track_life
from battery_env.lab.running import forecast_end
from battery_env.loads import Cycle, Load

discharges = load_nasa_discharges("B0005")[:13]
life = track_life(discharges[:12], cut_off_V=2.7)

record = discharges[12].loaded_part(cut_off_V=2.7)
pulses = Cycle(Load(np.array([0.0, 30.0]), np.array([3.0, 0.0]), "current"), period_s=60.0)
for load in (None, pulses):
    print(forecast_end(record.until(1200.0), Settings(nominal_Ah=2.0), load, life=life).summary())
print(f"measured, at the load so far: {record.time_s[-1]:.0f} s")
print("discharges to 1.4 Ah (5, 50, 95 %):", life.remaining_discharges(threshold_Ah=1.4))
