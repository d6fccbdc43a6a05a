"""The observations of the lateness window: kept per cell in order of time, folded in it whatever order they come in.

A slot's live row is its belief after everything. While it has observations younger than the checkpoint it has a window:
these observations, and the row as it was before them. An observation at the end of the order is folded onto the live
row; one in between makes the window stale, and once a batch is in, stale windows are folded anew. When all of a window
is older than the checkpoint the live row is what the checkpoint's would be, and the window is given back.
Both rows see the same operations in the same order, so that they agree bit for bit.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from fleet_service.fusion.belief import VALUE, Bins
from fleet_service.fusion.cells import NOBODY, NONE, Int32Array, Records, copy_slot
from fleet_service.fusion.pairs import chain, earlier, pair_of, remember
from fleet_service.fusion.pools import FREE_ENTRIES, FREE_WINDOWS, VOICES, WITNESSES, State
from fleet_service.fusion.table import pair_place
from fleet_service.fusion.trust import meet
from fleet_service.fusion.votes import SCRATCH, fold, recall, respread, speaks, voice_of
from fleet_service.fusion.weather import Weather
from schemas.numeric import BoolArray, ByteArray, Float32Array, IntArray, lean

# Rows whose memory is asked for at once before they are worked on: the processor waits for all of them together instead
# of for each; they fit into its second cache.
AHEAD: Final = 256


def absorb(
    state: State, weather: Weather, slots: IntArray, rows: IntArray, share: Float32Array,
    time: IntArray, number: IntArray, boot: IntArray, place: IntArray, vehicle: IntArray, weight: Float32Array,
    evidence: ByteArray, said: Float32Array, most: int,
) -> BoolArray:  # fmt: skip
    """Take observations `rows` (k,) of a batch (n,) into the windows of `slots` (k,) with `share` (k,), and fold them.

    Every pool must have k free places. Returns which observations (n,) were left out, because `most` of their vehicle
    wait in their cell already; of the votes of an observation its own cell's comes first and decides.
    """
    left_out, stale = np.zeros(len(time), np.bool_), np.empty(len(slots), np.int32)
    scratch = np.zeros((3, SCRATCH), np.float32)
    waiting = _absorb(
        state, weather, slots, rows, share, time, number, boot, place, vehicle, weight, evidence, said, most, left_out,
        np.zeros(len(time), np.bool_), stale, scratch,
    )  # fmt: skip
    _refold(state, weather, stale[:waiting], scratch)
    return left_out


@lean
def _absorb(
    state: State, weather: Weather, slots: IntArray, rows: IntArray, share: Float32Array,
    time: IntArray, number: IntArray, boot: IntArray, place: IntArray, vehicle: IntArray, weight: Float32Array,
    evidence: ByteArray, said: Float32Array, most: int, left_out: BoolArray, seen: BoolArray, stale: Int32Array,
    scratch: Bins,
) -> int:  # fmt: skip
    """Fills `left_out` and notes in `stale` the windows that have to be folded anew; returns how many. `seen` (n,) is
    for keeps."""
    cells, windows, entries, pairs, voices = state.cells, state.windows, state.entries, state.pairs, state.voices
    asked, waiting = 0, 0
    for k in range(len(slots)):
        if k % AHEAD == 0:
            asked += _ask(state, slots[k : k + AHEAD], rows[k : k + AHEAD], vehicle)
        row, slot = rows[k], slots[k]
        if left_out[row] or asked < 0:  # never below: but what was asked for must be used
            continue
        pair = pair_of(pairs, state.used, slot, vehicle[row])
        if not seen[row] and pairs[pair].waiting >= most:
            left_out[row] = True
            continue
        seen[row] = True
        state.used[FREE_ENTRIES] -= 1
        entry = int(state.free_entries[state.used[FREE_ENTRIES]])
        new = entries[entry]
        new.vehicle, new.share = vehicle[row], share[k]
        new.time, new.number, new.boot, new.place = time[row], number[row], boot[row], place[row]
        new.weight = weight[row]
        for i in range(evidence.shape[1]):
            new.evidence[i] = evidence[row, i]
        voice_of(entries, entry, said[row], scratch)
        window = int(cells[slot].window)
        if window == NONE:
            window = _open(state, slot)
        if cells[slot].voice == NONE and speaks(entries, entry):
            _speak(state, slot)
        _link(windows, entries, window, entry)
        chain(entries, pairs, pair, entry)
        if windows[window].stale:
            continue
        if new.following != NONE:
            windows[window].stale = 1
            stale[waiting] = window
            waiting += 1
            continue
        recall(entries, pairs, entry)
        fold(state.belief, cells, slot, voices, cells[slot].voice, entries, entry, weather, scratch)
    return waiting


@lean
def _ask(state: State, slots: IntArray, rows: IntArray, vehicle: IntArray) -> int:
    """Read the first of everything that observations `rows` (k,) in `slots` (k,) will touch."""
    seen, free = 0, state.used[FREE_ENTRIES] - 1
    for k in range(len(slots)):
        slot = slots[k]
        seen += state.belief[slot, 0] + state.cells[slot].visits
        seen += state.pairs[pair_place(state.pairs, slot, vehicle[rows[k]])].waiting
        if state.cells[slot].window != NONE:
            seen += state.entries[state.windows[state.cells[slot].window].tail].kind
        coming = state.entries[state.free_entries[free - k]]
        seen += coming.kind + coming.evidence[0] + coming.evidence[31]
    return seen


@lean
def _open(state: State, slot: int) -> int:
    """A window for a slot that has none, with its row as it is."""
    state.used[FREE_WINDOWS] -= 1
    window = int(state.free_windows[state.used[FREE_WINDOWS]])
    cells, new = state.cells, state.windows[window]
    cells[slot].window = window
    new.slot, new.head, new.tail, new.stale, new.values = slot, NONE, NONE, 0, 0
    copy_slot(state.belief, cells, slot, state.kept_belief, state.kept, window)
    voice = cells[slot].voice
    for side in range(2):
        for k in range(WITNESSES):
            new.witness[side, k] = NOBODY if voice == NONE else state.voices[voice].witness[side, k]
            new.witnessed[side, k] = 0 if voice == NONE else state.voices[voice].witnessed[side, k]
    return window


@lean
def _speak(state: State, slot: int) -> None:
    """Voices for a slot that gets its first value or witness."""
    voice = state.used[VOICES]
    state.used[VOICES] += 1
    state.cells[slot].voice = voice
    state.voices[voice].speaker[:] = NOBODY
    state.voices[voice].witness[:] = NOBODY


@lean
def _refold(state: State, weather: Weather, stale: Int32Array, scratch: Bins) -> None:
    cells, windows, entries, voices = state.cells, state.windows, state.entries, state.voices
    for window in stale:
        slot = int(windows[window].slot)
        voice = cells[slot].voice
        copy_slot(state.kept_belief, state.kept, window, state.belief, cells, slot)
        if voice != NONE:
            for side in range(2):
                for k in range(WITNESSES):
                    voices[voice].witness[side, k] = windows[window].witness[side, k]
                    voices[voice].witnessed[side, k] = windows[window].witnessed[side, k]
        entry = windows[window].head
        while entry != NONE:
            recall(entries, state.pairs, entry)
            respread(entries, entry, scratch)
            fold(state.belief, cells, slot, voices, voice, entries, entry, weather, scratch)
            entry = entries[entry].following
        windows[window].stale = 0


def settle(
    state: State, weather: Weather, peers: Records, names: Records, due_windows: IntArray, before: int
) -> None:  # fmt: skip
    """Let the checkpoint pass to `before` [ns] in the windows (k,), one after the other."""
    _settle(state, weather, peers, names, due_windows, before, np.zeros((3, SCRATCH), np.float32))


@lean
def _ask_settled(state: State, windows: IntArray) -> int:
    """Read the first of everything that settling windows (k,) will touch."""
    seen = 0
    for window in windows:
        head = state.entries[state.windows[window].head]
        seen += state.cells[state.windows[window].slot].visits + state.pairs[head.pair].waiting + head.evidence[0]
    return seen


@lean
def _settle(
    state: State, weather: Weather, peers: Records, names: Records, settled: IntArray, before: int, scratch: Bins
) -> None:  # fmt: skip
    cells, windows, entries = state.cells, state.windows, state.entries
    asked = 0
    for k in range(len(settled)):
        if k % AHEAD == 0:
            asked += _ask_settled(state, settled[k : k + AHEAD])
        window = settled[k]
        slot = int(windows[window].slot)
        whole = entries[windows[window].tail].time < before
        entry = int(windows[window].head)
        while entry != NONE and entries[entry].time < before:
            if not whole:
                respread(entries, entry, scratch)
                fold(state.kept_belief, state.kept, window, windows, window, entries, entry, weather, scratch)
            if entries[entry].kind == VALUE:
                windows[window].values -= 1
                meet(state.voices, cells[slot].voice, peers, names, entries, entry)
            remember(entries, state.pairs, entry)
            state.free_entries[state.used[FREE_ENTRIES]] = entry
            state.used[FREE_ENTRIES] += 1
            entry = int(entries[entry].following)
        windows[window].head = entry
        if entry == NONE and asked >= 0:
            cells[slot].window = NONE
            windows[window].slot = NONE
            state.free_windows[state.used[FREE_WINDOWS]] = window
            state.used[FREE_WINDOWS] += 1
        else:
            entries[entry].previous = NONE
            windows[window].first = entries[entry].time


@lean
def _link(windows: Records, entries: Records, window: int, entry: int) -> None:
    """Put an entry at its place in time; from the end, where nearly all belong."""
    after = windows[window].tail
    while after != NONE and earlier(entries, entry, after):
        after = entries[after].previous
    following = windows[window].head if after == NONE else entries[after].following
    entries[entry].previous = after
    entries[entry].following = following
    windows[window].values += entries[entry].kind == VALUE
    if after == NONE:
        windows[window].head = entry
        windows[window].first = entries[entry].time
    else:
        entries[after].following = entry
    if following == NONE:
        windows[window].tail = entry
    else:
        entries[following].previous = entry
