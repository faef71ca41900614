// What the calibration says about an answer: threshold, correction for the rig, features outside its range.
import type { Answer } from '../contract';

type Calibrated = Pick<Answer, 'threshold' | 'rig_correction' | 'extrapolated'>;

/** Rows of a name and a value. Empty without calibration. */
export function calibrationRows(answer: Calibrated): [string, string][] {
  return [...thresholdRow(answer), ...rigRow(answer), ...extrapolatedRow(answer)];
}

function thresholdRow({ threshold }: Calibrated): [string, string][] {
  if (threshold === null) return [];
  const share = `${Number((100 * threshold.false_accept_rate).toPrecision(2))} %`;
  return [['threshold', `confidence ${threshold.confidence.toFixed(2)}; at most ${share} of out-of-map queries reach it`]];
}

/** The map may have corrections for several rigs. An answer without one has the calibration of the map. */
function rigRow({ rig_correction }: Calibrated): [string, string][] {
  return rig_correction === null ? [] : [['confidence corrected for', rig_correction]];
}

/** Features outside the range of the calibration data: there the confidence may be wrong. */
function extrapolatedRow({ extrapolated }: Calibrated): [string, string][] {
  const features = Object.entries(extrapolated).map(([name, size]) => `${name} ${size > 0 ? '+' : '−'}${Math.abs(size).toFixed(1)} σ`);
  return features.length === 0 ? [] : [['confidence is extrapolated', features.join(', ')]];
}
