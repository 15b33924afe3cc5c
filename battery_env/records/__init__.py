"""Records of discharges: their samples, discharges of recorded cells, and the model under the current of a record."""

from battery_env.records.history import ChargeBefore as ChargeBefore
from battery_env.records.history import ChargeHistory as ChargeHistory
from battery_env.records.history import history_of as history_of
from battery_env.records.load import LEAST_LOAD_SHARE as LEAST_LOAD_SHARE
from battery_env.records.load import LOAD_SHARE as LOAD_SHARE
from battery_env.records.load import REST_CURRENT_A as REST_CURRENT_A
from battery_env.records.load import STEADY_S as STEADY_S
from battery_env.records.load import SWITCH_SHARE as SWITCH_SHARE
from battery_env.records.load import VARIED_SHARE as VARIED_SHARE
from battery_env.records.load import ExpectedCurrent as ExpectedCurrent
from battery_env.records.load import LoadSpan as LoadSpan
from battery_env.records.load import drawn as drawn
from battery_env.records.load import expected_current as expected_current
from battery_env.records.load import is_load as is_load
from battery_env.records.load import load_span as load_span
from battery_env.records.load import resample_current as resample_current
from battery_env.records.load import switches as switches
from battery_env.records.samples import CUT_OFF_V as CUT_OFF_V
from battery_env.records.samples import Record as Record
from battery_env.records.samples import Samples as Samples
from battery_env.records.samples import Stream as Stream
from battery_env.records.samples import check_drawn_charge as check_drawn_charge
from battery_env.records.samples import check_record as check_record
from battery_env.records.samples import check_sample as check_sample
from battery_env.records.samples import drawn_charge_C as drawn_charge_C
from battery_env.records.samples import mean_current_A as mean_current_A
