// A query: two images and the JSON of the request, as the user gave them.
import type { LocalizeRequest, Prior, Truth } from '../contract';

export interface NamedBlob {
  name: string;
  blob: Blob;
}

export interface Query {
  rgb: NamedBlob | null;
  depth: NamedBlob | null;
  /** JSON text, pasted or from a file. */
  request: string;
  truth: Truth | null;
}

export const NO_QUERY: Query = { rgb: null, depth: null, request: '', truth: null };

/** The request with the shown map and the drawn prior. */
export function requestFrom(query: Query, map: string | null, prior: Prior | null): LocalizeRequest {
  let read: unknown;
  try {
    read = JSON.parse(query.request);
  } catch (error) {
    throw new Error(`The request is not JSON: ${error instanceof Error ? error.message : String(error)}`, { cause: error });
  }
  if (typeof read !== 'object' || read === null || !('camera' in read)) {
    throw new Error('The request lacks "camera": width, height, fx, fy, cx, cy in pixels.');
  }
  const request = withoutNulls(read) as LocalizeRequest;
  if (map !== null && request.map === undefined) request.map = map;
  if (prior !== null) request.prior = prior;
  return request;
}

/** Leave out empty fields. */
function withoutNulls(value: unknown): unknown {
  if (Array.isArray(value)) return value.map(withoutNulls);
  if (typeof value !== 'object' || value === null) return value;
  const kept = Object.entries(value).filter(([, each]) => each !== null && !(Array.isArray(each) && each.length === 0));
  return Object.fromEntries(kept.map(([key, each]) => [key, withoutNulls(each)]));
}

export function bodyFrom(query: Query, request: LocalizeRequest): FormData {
  if (query.rgb === null || query.depth === null) throw new Error('Add an RGB image and a depth image.');
  const body = new FormData();
  body.append('rgb', query.rgb.blob, query.rgb.name);
  body.append('depth', query.depth.blob, query.depth.name);
  body.append('request', JSON.stringify(request));
  return body;
}
