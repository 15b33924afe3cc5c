"""q_max, R_o and the end of discharge of a real cell, from its recorded voltage and current, over its life."""

from battery_env import LeastSquares, load_nasa_discharges

fit = LeastSquares(thermal=True, mismatch_V=0.05)
print("cycle  capacity_Ah  q_mobile_C  sd_C   r_o_ohm  EOD_s (measured)")
for discharge in load_nasa_discharges("B0005")[::24]:
    record = discharge.loaded_part(cut_off_V=2.7)
    estimate = fit.estimate(record)
    eod_time_s = fit.model.forecast(record, estimate, cut_off_V=2.7).eod_time_s
    print(
        f"{discharge.meta['cycle']:5d}  {discharge.meta['capacity_Ah']:11.3f}  {estimate.q_mobile:10.0f}  "
        f"{estimate.sd_q_mobile:4.0f}  {estimate.r_o:8.4f}  {eod_time_s:5.0f} ({record.time_s[-1]:.0f})"
    )
