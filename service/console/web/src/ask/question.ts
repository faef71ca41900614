// What is asked: two pictures and the JSON beside them, as the user put them together.
import type { LocalizeRequest, Prior, Truth } from '../contract';

export interface NamedBlob {
  name: string;
  blob: Blob;
}

export interface Question {
  rgb: NamedBlob | null;
  depth: NamedBlob | null;
  /** JSON text, as pasted or as a file held it. */
  request: string;
  truth: Truth | null;
}

export const NO_QUESTION: Question = { rgb: null, depth: null, request: '', truth: null };

/** The request with the map that is shown, and with the prior that was drawn. */
export function requestFrom(question: Question, map: string | null, prior: Prior | null): LocalizeRequest {
  let read: unknown;
  try {
    read = JSON.parse(question.request);
  } catch (error) {
    throw new Error(`The request is no JSON: ${error instanceof Error ? error.message : String(error)}`, { cause: error });
  }
  if (typeof read !== 'object' || read === null || !('camera' in read)) {
    throw new Error('The request lacks "camera": width, height, fx, fy, cx, cy in pixels.');
  }
  const request = withoutNulls(read) as LocalizeRequest;
  if (map !== null && request.map === undefined) request.map = map;
  if (prior !== null) request.prior = prior;
  return request;
}

/** What was left empty need not be said. */
function withoutNulls(value: unknown): unknown {
  if (Array.isArray(value)) return value.map(withoutNulls);
  if (typeof value !== 'object' || value === null) return value;
  const kept = Object.entries(value).filter(([, each]) => each !== null && !(Array.isArray(each) && each.length === 0));
  return Object.fromEntries(kept.map(([key, each]) => [key, withoutNulls(each)]));
}

export function bodyFrom(question: Question, request: LocalizeRequest): FormData {
  if (question.rgb === null || question.depth === null) throw new Error('Give both pictures: RGB and depth.');
  const body = new FormData();
  body.append('rgb', question.rgb.blob, question.rgb.name);
  body.append('depth', question.depth.blob, question.depth.name);
  body.append('request', JSON.stringify(request));
  return body;
}
