"""The observations of the lateness window: kept per cell in order of time, folded in it whatever order they come in.

A slot's live row is its belief after everything. While it has observations younger than the checkpoint it has a window:
these observations, and the row as it was before them. An observation at the end of the order is folded onto the live
row; one in between makes the window stale, and once a batch is in, stale windows are folded anew. When all of a window
is older than the checkpoint the live row is what the checkpoint's would be, and the window is given back.
Both rows see the same operations in the same order, so that they agree bit for bit.
"""

from __future__ import annotations

import numpy as np

from fleet_service.fusion.belief import VALUE, Bins
from fleet_service.fusion.cells import NOBODY, NONE, Records, copy_slot
from fleet_service.fusion.pairs import chain, earlier, pair_of, remember
from fleet_service.fusion.pools import FREE_ENTRIES, FREE_WINDOWS, VOICES, WITNESSES, State
from fleet_service.fusion.trust import meet
from fleet_service.fusion.votes import SCRATCH, fold, recall, respread, speaks, voice_of
from fleet_service.fusion.weather import Weather
from schemas.numeric import BoolArray, ByteArray, Float32Array, IntArray, compiled, released


@released
def absorb(
    state: State, weather: Weather, slots: IntArray, rows: IntArray, share: Float32Array,
    time: IntArray, number: IntArray, boot: IntArray, place: IntArray, vehicle: IntArray, weight: Float32Array,
    evidence: ByteArray, said: Float32Array, most: int,
) -> BoolArray:  # fmt: skip
    """Take observations `rows` (k,) of a batch (n,) into the windows of `slots` (k,) with `share` (k,), and fold them.

    Every pool must have k free places. Returns which observations (n,) were left out, because `most` of their vehicle
    wait in their cell already; of the votes of an observation its own cell's comes first and decides.
    """
    cells, windows, entries, pairs, voices = state.cells, state.windows, state.entries, state.pairs, state.voices
    scratch = np.zeros((3, SCRATCH), np.float32)
    stale, waiting = np.empty(len(slots), np.int32), 0
    left_out, seen = np.zeros(len(time), np.bool_), np.zeros(len(time), np.bool_)
    for k in range(len(slots)):
        row, slot = rows[k], slots[k]
        if left_out[row]:
            continue
        pair = pair_of(pairs, state.used, slot, vehicle[row])
        if not seen[row] and pairs[pair].waiting >= most:
            left_out[row] = True
            continue
        seen[row] = True
        state.used[FREE_ENTRIES] -= 1
        entry = int(state.free_entries[state.used[FREE_ENTRIES]])
        new = entries[entry]
        new.slot, new.vehicle, new.share = slot, vehicle[row], share[k]
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
    for k in range(waiting):
        _refold(state, weather, stale[k], scratch)
    return left_out


@compiled
def _open(state: State, slot: int) -> int:
    """A window for a slot that has none, with its row as it is."""
    state.used[FREE_WINDOWS] -= 1
    window = int(state.free_windows[state.used[FREE_WINDOWS]])
    cells, new = state.cells, state.windows[window]
    cells[slot].window = window
    new.slot, new.head, new.tail, new.stale = slot, NONE, NONE, 0
    copy_slot(state.belief, cells, slot, state.kept_belief, state.kept, window)
    voice = cells[slot].voice
    for side in range(2):
        for k in range(WITNESSES):
            new.witness[side, k] = NOBODY if voice == NONE else state.voices[voice].witness[side, k]
            new.witnessed[side, k] = 0 if voice == NONE else state.voices[voice].witnessed[side, k]
    return window


@compiled
def _speak(state: State, slot: int) -> None:
    """Voices for a slot that gets its first value or witness."""
    voice = state.used[VOICES]
    state.used[VOICES] += 1
    state.cells[slot].voice = voice
    state.voices[voice].speaker[:] = NOBODY
    state.voices[voice].witness[:] = NOBODY


@compiled
def _refold(state: State, weather: Weather, window: int, scratch: Bins) -> None:
    cells, windows, entries, voices = state.cells, state.windows, state.entries, state.voices
    slot = int(windows[window].slot)
    voice = cells[slot].voice
    copy_slot(state.kept_belief, state.kept, window, state.belief, cells, slot)
    if voice != NONE:
        voices[voice].witness[:] = windows[window].witness
        voices[voice].witnessed[:] = windows[window].witnessed
    entry = windows[window].head
    while entry != NONE:
        recall(entries, state.pairs, entry)
        respread(entries, entry, scratch)
        fold(state.belief, cells, slot, voices, voice, entries, entry, weather, scratch)
        entry = entries[entry].following
    windows[window].stale = 0


@released
def settle(
    state: State, weather: Weather, peers: Records, names: Records, open_windows: IntArray, before: int
) -> None:  # fmt: skip
    """Let the checkpoint pass to `before` [ns] in the windows (k,).

    Values that pass meet those of others, which is what reputation is made of.
    """
    cells, windows, entries = state.cells, state.windows, state.entries
    scratch = np.zeros((3, SCRATCH), np.float32)
    for window in open_windows:
        slot = int(windows[window].slot)
        whole = entries[windows[window].tail].time < before
        entry = int(windows[window].head)
        while entry != NONE and entries[entry].time < before:
            if not whole:
                respread(entries, entry, scratch)
                fold(state.kept_belief, state.kept, window, windows, window, entries, entry, weather, scratch)
            if entries[entry].kind == VALUE:
                meet(state.voices, cells[slot].voice, peers, names, entries, entry)
            remember(entries, state.pairs, entry)
            state.free_entries[state.used[FREE_ENTRIES]] = entry
            state.used[FREE_ENTRIES] += 1
            entry = int(entries[entry].following)
        windows[window].head = entry
        if entry == NONE:
            cells[slot].window = NONE
            windows[window].slot = NONE
            state.free_windows[state.used[FREE_WINDOWS]] = window
            state.used[FREE_WINDOWS] += 1
        else:
            entries[entry].previous = NONE


@compiled
def _link(windows: Records, entries: Records, window: int, entry: int) -> None:
    """Put an entry at its place in time; from the end, where nearly all belong."""
    after = windows[window].tail
    while after != NONE and earlier(entries, entry, after):
        after = entries[after].previous
    following = windows[window].head if after == NONE else entries[after].following
    entries[entry].previous = after
    entries[entry].following = following
    if after == NONE:
        windows[window].head = entry
    else:
        entries[after].following = entry
    if following == NONE:
        windows[window].tail = entry
    else:
        entries[following].previous = entry
