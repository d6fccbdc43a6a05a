// The sound of a new alert.
let hearing = null;

/** Play a tone of half a second. */
export function beep() {
  hearing ??= new AudioContext();
  const tone = hearing.createOscillator(), volume = hearing.createGain();
  tone.frequency.value = 740;
  volume.gain.setValueAtTime(.15, hearing.currentTime);
  volume.gain.exponentialRampToValueAtTime(.001, hearing.currentTime + .5);
  tone.connect(volume).connect(hearing.destination);
  tone.start();
  tone.stop(hearing.currentTime + .5);
}
