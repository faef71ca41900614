// Whether fx and fy may be off by a factor of two. The rule is that of `streetfix localize`. A test compares the numbers in
// `focal_length_rule.json`, and the results, with those of the command.
import type { Answer, LocalizeRequest } from '../contract';
import { percent } from '../numbers';
import { ServiceError } from '../service';
import rule from './focal_length_rule.json';

/** Answer to the query with changed fx and fy. */
export interface Trial {
  factor: number;
  answer: Answer;
}

export interface Check {
  /** Trials that the service answered. */
  trials: Trial[];
  /** Trials that failed. */
  failures: { factor: number; error: unknown }[];
}

/** Whether to check: there is no pose, or the camera seems to be at about half or twice the usual height. */
export function needsCheck({ status, camera_height: height }: Answer): boolean {
  if (status !== 'LOCALIZED') return true;
  if (height === null || height.origin !== 'estimated') return false;
  const ratio = height.height_m / rule.usual_height_m;
  return rule.suspicious_ratios.some(([least, most]) => least !== undefined && most !== undefined && least <= ratio && ratio <= most);
}

export function withFocalFactor(request: LocalizeRequest, factor: number): LocalizeRequest {
  const { camera } = request;
  return { ...request, camera: { ...camera, fx: factor * camera.fx, fy: factor * camera.fy } };
}

/** Send the query once for each factor. A failed trial does not stop the others. Null: `goesOn` said that the result is no longer wanted. */
export async function checkFocalLength(ask: (factor: number) => Promise<Answer>, goesOn: () => boolean): Promise<Check | null> {
  const check: Check = { trials: [], failures: [] };
  for (const factor of rule.factors) {
    try {
      check.trials.push({ factor, answer: await ask(factor) });
    } catch (error) {
      check.failures.push({ factor, error });
    }
    if (!goesOn()) return null;
  }
  return check;
}

/** The trial that fits the map clearly better than the given camera. One that is LOCALIZED goes before one that is not. */
export function fittingTrial(before: Answer, trials: readonly Trial[]): Trial | null {
  let best: Trial | null = null;
  let [isBestLocalized, mostGained] = [false, rule.gain_nats];
  for (const trial of trials) {
    const gained = supportOf(trial.answer) - supportOf(before);
    const isLocalized = trial.answer.status === 'LOCALIZED' && gained > 0;
    if (isLocalized === isBestLocalized ? gained >= mostGained : isLocalized) {
      best = trial;
      [isBestLocalized, mostGained] = [isLocalized, gained];
    }
  }
  return best;
}

/** Support of the first hypothesis, nats; 0 if nothing could be registered. */
function supportOf({ hypotheses: [first] }: Answer): number {
  return first === undefined ? 0 : rule.inliers_nats * first.inliers + rule.similarity_nats * first.similarity;
}

export const CHECKING = `Checking the focal length with ${rule.factors.length} further queries: fx and fy ${changes(rule.factors)}.`;

/** What the check shows. It says nothing of a trial that failed, except that it failed. */
export function textOf(before: Answer, check: Check): { text: string; found: boolean } {
  const found = fittingTrial(before, check.trials);
  const sentences: string[] = [];
  if (found !== null) {
    sentences.push(`With fx and fy ${changes([found.factor])}, ${gainOf(before, found.answer)}. Check the focal length and the image size.`);
  } else if (check.trials.length > 0) {
    sentences.push(`Focal length checked: with fx and fy ${changes(check.trials.map((each) => each.factor))}, the images do not fit the map clearly better.`);
  }
  for (const { factor, error } of check.failures) {
    const why = error instanceof ServiceError ? error.title : String(error);
    sentences.push(`The query with fx and fy ${changes([factor])} failed: ${why}${why.endsWith('.') ? '' : '.'}`);
  }
  return { text: sentences.join(' '), found: found !== null };
}

function gainOf({ confidence: before }: Answer, { confidence: after }: Answer): string {
  if (before === null || after === null || after <= before || percent(after) === percent(before)) return 'the images fit the map better';
  return `the confidence is ${percent(after)} instead of ${percent(before)}`;
}

function changes(factors: readonly number[]): string {
  return factors.map((factor) => ({ 0.5: 'halved', 2: 'doubled' })[factor] ?? `times ${factor}`).join(' and ');
}
