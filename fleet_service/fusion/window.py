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
from fleet_service.fusion.cells import NOBODY, NONE, Int32Array, Records, copy_slot
from fleet_service.fusion.pairs import chain, earlier, pair_of, remember
from fleet_service.fusion.pools import FREE_ENTRIES, FREE_WINDOWS, VOICES, WITNESSES, State
from fleet_service.fusion.table import AHEAD, first_place
from fleet_service.fusion.trust import meet
from fleet_service.fusion.votes import SCRATCH, fold, recall, respread, speaks, voice_of
from fleet_service.fusion.weather import Weather
from schemas.numeric import BoolArray, ByteArray, Float32Array, IntArray
from schemas.runtime.jit import compiled, prefetch, refcount_free, refcount_free_inlined


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


@refcount_free
def _absorb(
    state: State, weather: Weather, slots: IntArray, rows: IntArray, share: Float32Array,
    time: IntArray, number: IntArray, boot: IntArray, place: IntArray, vehicle: IntArray, weight: Float32Array,
    evidence: ByteArray, said: Float32Array, most: int, left_out: BoolArray, seen: BoolArray, stale: Int32Array,
    scratch: Bins,
) -> int:  # fmt: skip
    """Fills `left_out` and notes in `stale` the windows that have to be folded anew; returns how many. `seen` (n,) is
    for keeps."""
    cells, windows, entries, pairs, voices = state.cells, state.windows, state.entries, state.pairs, state.voices
    waiting = 0
    for k in range(len(slots)):
        if k % AHEAD == 0:
            _ask(state, slots, rows, vehicle, k, min(k + AHEAD, len(slots)))
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
            _speak(state, slot, window)
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


@refcount_free_inlined
def _ask(state: State, slots: IntArray, rows: IntArray, vehicle: IntArray, begin: int, end: int) -> None:
    """Ask for all that observations `begin` to `end` will touch; last for what lies behind a number that comes first.

    No branch waits for memory: a processor that guesses it wrongly forgets what it asked for meanwhile.
    """
    cells, windows, used = state.cells, state.windows, state.used
    for k in range(begin, end):
        slot = slots[k]
        prefetch(cells, slot, 0)
        prefetch(state.belief, slot, 0)
        pair = first_place(state.pairs, slot, vehicle[rows[k]])
        prefetch(state.pairs, pair, 0)
        prefetch(state.pairs, pair, 1)
        entry = state.free_entries[used[FREE_ENTRIES] - 1 - (k - begin)]
        prefetch(state.entries, entry, 0)
        prefetch(state.entries, entry, 1)
        window = state.free_windows[used[FREE_WINDOWS] - 1 - (k - begin)]
        prefetch(state.kept, window, 0)
        prefetch(state.kept_belief, window, 0)
        prefetch(windows, window, 0)
    for k in range(begin, end):
        prefetch(windows, max(cells[slots[k]].window, 0), 0)
        voice = max(cells[slots[k]].voice, 0)
        prefetch(state.voices, voice, 1)
        prefetch(state.voices, voice, 2)
    for k in range(begin, end):
        prefetch(state.entries, windows[max(cells[slots[k]].window, 0)].tail, 0)


@refcount_free_inlined
def _open(state: State, slot: int) -> int:
    """A window for a slot that has none, with its row as it is."""
    state.used[FREE_WINDOWS] -= 1
    window = int(state.free_windows[state.used[FREE_WINDOWS]])
    cells, new = state.cells, state.windows[window]
    cells[slot].window = window
    new.slot, new.head, new.tail, new.stale, new.values = slot, NONE, NONE, 0, 0
    copy_slot(state.belief, cells, slot, state.kept_belief, state.kept, window)
    voice = cells[slot].voice
    if voice != NONE:
        _copy_witnesses(state.voices, voice, state.kept_voices, window)
    return window


@refcount_free_inlined
def _copy_witnesses(voices: Records, voice: int, to_voices: Records, to: int) -> None:
    for side in range(2):
        for k in range(WITNESSES):
            to_voices[to].witness[side, k] = voices[voice].witness[side, k]
            to_voices[to].witnessed[side, k] = voices[voice].witnessed[side, k]


@refcount_free
def _speak(state: State, slot: int, window: int) -> None:
    """Voices for a slot, with a window, that gets its first value or witness for long."""
    voice = state.used[VOICES]
    state.used[VOICES] += 1
    state.cells[slot].voice = voice
    state.voices[voice].speaker[:] = NOBODY
    state.voices[voice].witness[:] = NOBODY
    _copy_witnesses(state.voices, voice, state.kept_voices, window)


@refcount_free
def _refold(state: State, weather: Weather, stale: Int32Array, scratch: Bins) -> None:
    cells, windows, entries, voices = state.cells, state.windows, state.entries, state.voices
    for window in stale:
        slot = int(windows[window].slot)
        voice = cells[slot].voice
        copy_slot(state.kept_belief, state.kept, window, state.belief, cells, slot)
        if voice != NONE:
            _copy_witnesses(state.kept_voices, window, voices, voice)
        entry = windows[window].head
        while entry != NONE:
            recall(entries, state.pairs, entry)
            respread(entries, entry, scratch)
            fold(state.belief, cells, slot, voices, voice, entries, entry, weather, scratch)
            entry = entries[entry].following
        windows[window].stale = 0


@compiled
def due(windows: Records, before: int) -> tuple[IntArray, IntArray]:
    """Windows with entries before `before` [ns]: those without a value, and those with one."""
    quiet, talking, silent, loud = np.empty(len(windows), np.int64), np.empty(len(windows), np.int64), 0, 0
    for window in range(len(windows)):
        if windows[window].slot != NONE and windows[window].first < before:
            if windows[window].values:
                talking[loud] = window
                loud += 1
            else:
                quiet[silent] = window
                silent += 1
    return quiet[:silent], talking[:loud]


def settle(
    state: State, weather: Weather, peers: Records, names: Records, due_windows: IntArray, before: int
) -> None:  # fmt: skip
    """Let the checkpoint pass to `before` [ns] in the windows (k,), one after the other."""
    _settle(state, weather, peers, names, due_windows, before, np.zeros((3, SCRATCH), np.float32))


@refcount_free_inlined
def _ask_settled(state: State, settled: IntArray, begin: int, end: int) -> None:
    """Ask for all that settling windows `begin` to `end` will touch, in the same way."""
    windows, entries = state.windows, state.entries
    for k in range(begin, end):
        prefetch(windows, settled[k], 0)
    for k in range(begin, end):
        prefetch(entries, windows[settled[k]].head, 0)
        prefetch(entries, windows[settled[k]].tail, 0)
        prefetch(state.cells, windows[settled[k]].slot, 0)
    for k in range(begin, end):
        window = settled[k]
        prefetch(state.pairs, entries[windows[window].head].pair, 0)
        if windows[window].values:
            prefetch(state.voices, state.cells[windows[window].slot].voice, 0)
            prefetch(state.voices, state.cells[windows[window].slot].voice, 1)
        if windows[window].tail != windows[window].head:
            prefetch(entries, windows[window].head, 1)
            prefetch(entries, entries[windows[window].head].following, 0)
            prefetch(state.kept, window, 0)
            prefetch(state.kept_belief, window, 0)
    for k in range(begin, end):
        window = settled[k]
        if windows[window].tail != windows[window].head:
            prefetch(state.pairs, entries[entries[windows[window].head].following].pair, 0)


@refcount_free
def _settle(
    state: State, weather: Weather, peers: Records, names: Records, settled: IntArray, before: int, scratch: Bins
) -> None:  # fmt: skip
    cells, windows, entries = state.cells, state.windows, state.entries
    for k in range(len(settled)):
        if k % AHEAD == 0:
            _ask_settled(state, settled, k, min(k + AHEAD, len(settled)))
        window = settled[k]
        slot = int(windows[window].slot)
        whole = entries[windows[window].tail].time < before
        entry = int(windows[window].head)
        while entry != NONE and entries[entry].time < before:
            if not whole:
                respread(entries, entry, scratch)
                fold(
                    state.kept_belief, state.kept, window, state.kept_voices, window, entries, entry, weather, scratch
                )  # fmt: skip
            if entries[entry].kind == VALUE:
                windows[window].values -= 1
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
            windows[window].first = entries[entry].time


@refcount_free_inlined
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
