// The messages of the service as in openapi/openapi.json; metres and degrees.

export interface Vector {
  x: number;
  y: number;
  z: number;
}

export interface Quaternion extends Vector {
  w: number;
}

export interface Pose {
  position: Vector;
  orientation: Quaternion;
  heading_deg: number;
  covariance: number[] | null;
}

export type Status = 'LOCALIZED' | 'AMBIGUOUS' | 'OUT_OF_MAP';

export interface Hypothesis {
  /** True only for the first hypothesis of a LOCALIZED answer. */
  confirmed: boolean;
  pose: Pose;
  share: number;
  inliers: number;
  similarity: number;
}

export interface Neighbour {
  place: number;
  similarity: number;
  street: string | null;
  position: Vector;
  heading_deg: number;
}

export interface MapVersion {
  name: string;
  version: string;
}

/** Mean and covariance of the position over all hypotheses and the rest of the map. It is not a pose. */
export interface Spread {
  mean: Vector;
  /** 3 x 3, row by row. */
  covariance: number[];
  heading_std_deg: number;
  hypotheses_weight: number;
}

/** A possible cause in the query or the map. */
export interface Reason {
  check: string;
  /** Standard deviations from the mean of calibration. */
  evidence: Record<string, number>;
  remedy: string;
}

/** Height of the camera above the ground: from the request, estimated from the depth image, or assumed because no ground is visible. */
export interface CameraHeight {
  height_m: number;
  origin: 'given' | 'estimated' | 'assumed';
}

/** Street and pose are null unless the answer is LOCALIZED, the spread is null and the reasons are empty if it is. */
export interface Answer {
  status: Status;
  confidence: number | null;
  street: { id: string; name: string; vote: number } | null;
  pose: Pose | null;
  hypotheses: Hypothesis[];
  spread: Spread | null;
  reasons: Reason[];
  neighbours: Neighbour[];
  camera_height: CameraHeight | null;
  /** extrapolated: a confidence feature lies outside the range of the calibration data, so the confidence may be wrong. */
  calibration: 'in_range' | 'extrapolated' | null;
  extrapolated: Record<string, number>;
  /** Least confidence of a LOCALIZED answer, and an upper bound of the share of out-of-map queries that reach it. */
  threshold: { confidence: number; false_accept_rate: number } | null;
  /** Name of the correction for a rig that the confidence has. */
  rig_correction: string | null;
  map: MapVersion;
  timings_ms: { decode: number; fuse: number; encode: number; search: number; register: number; total: number };
}

export interface Explanation {
  answer: Answer;
  depth: string;
  fused: string;
  view: string | null;
  map_depth: string | null;
  points: { origin: Vector; count: number; data: string };
}

export interface Camera {
  width: number;
  height: number;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  distortion_model?: string;
}

export interface Prior {
  position?: { x: number; y: number; std_m: number } | null;
  heading_deg?: number | null;
  heading_std_deg?: number;
}

export interface LocalizeRequest {
  map?: string | null;
  camera: Camera;
  prior?: Prior | null;
  [other: string]: unknown;
}

export interface Truth {
  position: Vector;
  heading_deg: number | null;
}

export interface SamplePair {
  name: string;
  rgb: string;
  depth: string;
  request: LocalizeRequest;
  truth: Truth | null;
}

export interface MapEntry {
  name: string;
  version: string;
  made_at: string;
  places: number;
  views: number;
  streets: number;
  spacing_m: number;
  georeferenced: boolean;
  licence: string;
  versions: string[];
}

export interface StreetFeature {
  properties: { id: string; name: string; street: string; section: string | null };
  geometry: { type: 'Polygon'; coordinates: number[][][] } | { type: 'MultiPolygon'; coordinates: number[][][][] };
}

export interface LastAnswer {
  number: number;
  at: string;
  map: MapVersion;
  status: Status;
  confidence: number | null;
  street: string | null;
  position: Vector | null;
  heading_deg: number | null;
  frames: number;
  total_ms: number;
}
