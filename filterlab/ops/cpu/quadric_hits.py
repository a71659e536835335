"""The program that casts rays at quadrics: hits are put in order into the ray's row (`quadric_walk`)."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

from filterlab.ops.cpu import frame, job, quadric_walk
from filterlab.ops.cpu.lanes import DOUBLE, I1, I8, I32, I64, Value
from filterlab.ops.cpu.quadric_walk import Met, Ray, Walk
from filterlab.ops.quadrics import Kept
from filterlab.ops.tree import WIDTH

FIELDS: dict[str, type] = quadric_walk.FIELDS | {
    "sheets": ctypes.c_int64,  # k
    "tau": ctypes.c_void_p,  # (R, k) d, written: of the first hits in order; ∞ before
    "place": ctypes.c_void_p,  # (R, k) int64, written: of the quadrics; −1 before
}


class QuadricsJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class QuadricsVariant:
    """Everything the program depends on, apart from the machine; see `quadric_walk.WalkVariant`."""

    planes: int
    kept: Kept
    reversed: bool
    fused: bool

    def generate(self) -> str:
        """The program as LLVM IR text."""
        module, function = frame.new_module()
        _Program(self, function, FIELDS).write()
        return str(module)


class _Program(Walk):
    def cast(self, ray: Ray) -> None:
        e, b = self.lanes, self.builder
        row = b.mul(ray.number, self.job.sheets)
        self.taus, self.places = e.advance(self.job.tau, row, DOUBLE), e.advance(self.job.place, row, I64)
        self.slot = e.variable(I64(0))
        self.limit.value = DOUBLE(float("inf"))
        self.walk(ray, self._take)

    def _take(self, ray: Ray, met: Met, root: Value, hit: Value) -> None:
        """Those of a mask that come before the ray's last hit."""
        e, b = self.lanes, self.builder
        tau = e.add(root, met.behind)
        sooner = b.and_(hit, b.fcmp_ordered("<", tau, e.everywhere(self.limit.value)))
        self.bits.value = b.bitcast(sooner, I8)
        with e.repeat_while(lambda: b.icmp_unsigned("!=", self.bits.value, I8(0))):
            lane = b.cttz(self.bits.value, I1(0))
            self.bits.value = b.xor(self.bits.value, b.shl(I8(1), lane))
            place = b.add(b.mul(met.leaf, I64(WIDTH)), b.zext(lane, I64))
            self._insert(b.extract_element(tau, b.zext(lane, I32)), place)

    def _insert(self, tau: Value, place: Value) -> None:
        """Into the rows, in order, if it comes before the last one there."""
        e, b = self.lanes, self.builder
        last = b.sub(self.job.sheets, I64(1))
        with b.if_then(b.fcmp_ordered("<", tau, self.limit.value)):
            self.slot.value = last

            def goes_before() -> Value:
                """Whether the hit before the slot comes later."""
                before = b.sub(self.slot.value, I64(1))
                some = b.icmp_signed(">=", before, I64(0))
                safe = b.select(some, before, I64(0))
                return b.and_(some, b.fcmp_ordered("<", tau, self.number(self.taus, safe)))

            with e.repeat_while(goes_before):
                slot, before = self.slot.value, b.sub(self.slot.value, I64(1))
                b.store(self.number(self.taus, before), e.advance(self.taus, slot, DOUBLE))
                moved = b.load(e.advance(self.places, before, I64), typ=I64)
                b.store(moved, e.advance(self.places, slot, I64))
                self.slot.value = before
            b.store(tau, e.advance(self.taus, self.slot.value, DOUBLE))
            b.store(place, e.advance(self.places, self.slot.value, I64))
            self.limit.value = self.number(self.taus, last)
