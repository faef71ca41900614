// The horizontal part of a covariance as an ellipse.

export interface Ellipse {
  /** Standard deviations along the two axes, metres, the larger first. */
  major: number;
  minor: number;
  /** Of the larger axis, counter-clockwise from map x, radians. */
  angle: number;
}

/** 6 x 6 or 3 x 3, row by row, translation first, as the contract has it. */
export function ellipseOf(covariance: number[]): Ellipse {
  const [xx = 0, xy = 0] = covariance;
  const yy = covariance[Math.sqrt(covariance.length) + 1] ?? 0;
  const mean = (xx + yy) / 2;
  const spread = Math.hypot((xx - yy) / 2, xy);
  return {
    major: Math.sqrt(Math.max(0, mean + spread)),
    minor: Math.sqrt(Math.max(0, mean - spread)),
    angle: 0.5 * Math.atan2(2 * xy, xx - yy),
  };
}
