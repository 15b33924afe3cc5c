"""q_max, R_o and the capacity of a real cell over its life, from the recorded voltage and current of its discharges."""

from battery_env import load_nasa_discharges, track_life

discharges = load_nasa_discharges("B0005")[::24]
table = track_life(discharges, cut_off_V=2.7).table
table["measured_Ah"] = [discharge.meta["capacity_Ah"] for discharge in discharges]
print(table[["cycle", "measured_Ah", "capacity_Ah", "q_mobile_C", "sd_q_mobile_C", "r_o_ohm"]].round(4).to_string(index=False))
