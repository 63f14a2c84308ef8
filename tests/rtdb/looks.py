"""A look at a store that is well, from which the tests make others."""

from rtdb import ClockInfo, ComponentInfo, Flag, Kind
from rtdb.db.look import ComponentLook, Look, ObjectLook

S = 1_000_000_000
CLOCK = ClockInfo(Kind.REAL, True, 77, 100, 0, 0, 0, (0,) * 20, 10_000_000)
INFO = ComponentInfo("gps", 4242, True, 100, False, 0, "1.0", 1, 0)
FIX = ObjectLook(
    oid=1, name="gps/fix", record="GpsFix", component="gps", parent=0, flags=Flag(0), every=10, phase=3, head=20,
    refused=0, t_data_ns=9 * S, t_delete_ns=None,
)  # fmt: skip
NOW = Look(
    name="cart", host_ns=500 * S, now_ns=10 * S, t0_ns=0, cycle=100, tick_ns=10_000_000, clock=CLOCK,
    memory=(4 << 20, 3 << 20), components=(ComponentLook(info=INFO),), objects=(FIX,),
)  # fmt: skip
