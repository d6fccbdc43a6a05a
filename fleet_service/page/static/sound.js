// The sound of a new alert.
let hearing = null;

/** Play a tone of half a second. */
export function beep() {
  hearing ??= new AudioContext();
  const tone = hearing.createOscillator();
  const volume = hearing.createGain();
  tone.frequency.value = 740;
  volume.gain.setValueAtTime(0.15, hearing.currentTime);
  volume.gain.exponentialRampToValueAtTime(0.001, hearing.currentTime + 0.5);
  tone.connect(volume).connect(hearing.destination);
  tone.start();
  tone.stop(hearing.currentTime + 0.5);
}
