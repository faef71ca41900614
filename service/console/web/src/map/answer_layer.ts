// The answer: the pose with its covariance and field of view, or the hypotheses and the spread; and the most similar places.
import type { Answer, Camera, Pose, Truth, Vector } from '../contract';
import { ellipseOf } from './ellipse';
import type { Ink, Overlay, Point } from './overlay';
import type { Palette } from './palette';

const VIEW_M = 18;
/** The service keeps so much of a fisheye image on each side (MOST_ASIDE_DEG in service/imaging/rectify.py), radians. */
const MOST_ASIDE_RAD = Math.PI / 3;
/** Two dimensions, 95 %: this many standard deviations. */
const SIGMAS_95 = 2.4477;
const SMALLEST_PX = 5;

export interface Shown {
  answer: Answer;
  camera: Camera;
  truth: Truth | null;
}

export class AnswerLayer {
  shown: Shown | null = null;

  draw(overlay: Overlay, palette: Palette, metrePx: number): void {
    if (this.shown === null) return;
    const { answer, camera, truth } = this.shown;
    const colour = colourOf(answer, palette);
    answer.neighbours.forEach((neighbour) => {
      const at = overlay.at(neighbour.position.x, neighbour.position.y, neighbour.position.z);
      if (at !== null) overlay.dot(at, 5, { line: palette.neighbour, fill: palette.halo, width: 2 });
    });
    this.#drawUnconfirmed(overlay, palette, answer, colour);
    if (answer.spread !== null) this.#drawEllipse(overlay, answer.spread.mean, answer.spread.covariance, { line: colour, width: 2, dash: [6, 6] }, metrePx);
    if (answer.pose !== null) {
      this.#drawView(overlay, answer.pose, camera, colour, palette);
      const ink = { line: colour, fill: palette.answerFill, width: 2 };
      if (answer.pose.covariance !== null) this.#drawEllipse(overlay, answer.pose.position, answer.pose.covariance, ink, metrePx);
    }
    if (truth !== null) drawCross(overlay, truth.position, palette);
    const at = answer.pose === null ? null : positionOn(overlay, answer.pose);
    if (answer.pose !== null && at !== null) {
      overlay.dot(at, 7, { line: palette.halo, fill: colour, width: 2.5 });
      drawArrow(overlay, answer.pose, at, colour, palette);
    }
  }

  drawNames(overlay: Overlay, palette: Palette): void {
    if (this.shown === null) return;
    const { answer, truth } = this.shown;
    const colour = colourOf(answer, palette);
    if (answer.pose !== null) {
      const at = positionOn(overlay, answer.pose);
      if (at !== null) overlay.label('answer', [at[0], at[1] + 20], colour, palette.halo, true);
    } else {
      answer.hypotheses.forEach((hypothesis, k) => {
        const there = positionOn(overlay, hypothesis.pose);
        if (there !== null) overlay.label(`${ordinal(k + 1)}?`, [there[0], there[1] + 20], colour, palette.halo, true);
      });
    }
    if (truth !== null) {
      const there = overlay.at(truth.position.x, truth.position.y, truth.position.z);
      if (there !== null) overlay.label('truth', [there[0], there[1] - 18], palette.truth, palette.halo, true);
    }
    answer.neighbours.forEach((neighbour, k) => {
      const there = overlay.at(neighbour.position.x, neighbour.position.y, neighbour.position.z);
      if (there !== null) overlay.label(`n${k + 1}`, [there[0] + 14, there[1] - 8], palette.neighbour, palette.halo);
    });
  }

  #drawUnconfirmed(overlay: Overlay, palette: Palette, answer: Answer, colour: string): void {
    for (const hypothesis of answer.hypotheses.filter((each) => !each.confirmed)) {
      const at = positionOn(overlay, hypothesis.pose);
      if (at === null) continue;
      overlay.dot(at, 4 + 8 * Math.sqrt(hypothesis.share), { line: colour, fill: palette.halo, width: 2, dash: [3, 3] });
      drawArrow(overlay, hypothesis.pose, at, colour, palette);
    }
  }

  #drawView(overlay: Overlay, pose: Pose, camera: Camera, colour: string, palette: Palette): void {
    const heading = (pose.heading_deg * Math.PI) / 180;
    const left = sideOf(camera, camera.cx + 0.5);
    const right = sideOf(camera, camera.width - camera.cx - 0.5);
    const edge: Vector[] = [pose.position];
    for (let k = 0; k <= 16; k++) {
      const angle = heading + left - ((left + right) * k) / 16;
      edge.push({
        x: pose.position.x + VIEW_M * Math.cos(angle),
        y: pose.position.y + VIEW_M * Math.sin(angle),
        z: pose.position.z,
      });
    }
    overlay.path(edge, { line: colour, fill: palette.answerFill, width: 1.2 }, true);
  }

  #drawEllipse(overlay: Overlay, middle: Vector, covariance: number[], ink: Ink, metrePx: number): void {
    const ellipse = ellipseOf(covariance);
    if (SIGMAS_95 * ellipse.major * metrePx < SMALLEST_PX) return; // the mark covers it
    const edge: Vector[] = [];
    for (let k = 0; k < 48; k++) {
      const turn = (2 * Math.PI * k) / 48;
      const along = SIGMAS_95 * ellipse.major * Math.cos(turn);
      const across = SIGMAS_95 * ellipse.minor * Math.sin(turn);
      edge.push({
        x: middle.x + along * Math.cos(ellipse.angle) - across * Math.sin(ellipse.angle),
        y: middle.y + along * Math.sin(ellipse.angle) + across * Math.cos(ellipse.angle),
        z: middle.z,
      });
    }
    overlay.path(edge, ink, true);
  }
}

/** Angle between the optical axis and a side of the image, radians. The radius of a fisheye image is nearly an angle. */
function sideOf(camera: Camera, px: number): number {
  const radius = px / camera.fx;
  if (camera.distortion_model !== 'kannala_brandt') return Math.atan(radius);
  return Math.max(-MOST_ASIDE_RAD, Math.min(MOST_ASIDE_RAD, radius));
}

export function colourOf(answer: Answer, palette: Palette): string {
  return { LOCALIZED: palette.answer, AMBIGUOUS: palette.doubt, OUT_OF_MAP: palette.away }[answer.status];
}

function positionOn(overlay: Overlay, pose: Pose): Point | null {
  return overlay.at(pose.position.x, pose.position.y, pose.position.z);
}

/** A short arrow of constant length, so that the direction is visible at every zoom. */
function drawArrow(overlay: Overlay, pose: Pose, at: Point, colour: string, palette: Palette): void {
  const heading = (pose.heading_deg * Math.PI) / 180;
  const ahead = overlay.at(pose.position.x + Math.cos(heading), pose.position.y + Math.sin(heading), pose.position.z);
  if (ahead === null) return;
  const length = Math.hypot(ahead[0] - at[0], ahead[1] - at[1]) || 1;
  const [dx, dy] = [(ahead[0] - at[0]) / length, (ahead[1] - at[1]) / length];
  const context = overlay.context;
  for (const [line, width] of [[palette.halo, 5], [colour, 2.5]] as const) {
    context.beginPath();
    context.moveTo(at[0] + 7 * dx, at[1] + 7 * dy);
    context.lineTo(at[0] + 24 * dx, at[1] + 24 * dy);
    context.moveTo(at[0] + 17 * dx - 5 * dy, at[1] + 17 * dy + 5 * dx);
    context.lineTo(at[0] + 24 * dx, at[1] + 24 * dy);
    context.lineTo(at[0] + 17 * dx + 5 * dy, at[1] + 17 * dy - 5 * dx);
    context.setLineDash([]);
    context.lineWidth = width;
    context.strokeStyle = line;
    context.stroke();
  }
}

function drawCross(overlay: Overlay, position: Vector, palette: Palette): void {
  const at = overlay.at(position.x, position.y, position.z);
  if (at === null) return;
  const context = overlay.context;
  for (const [line, width] of [[palette.halo, 6], [palette.truth, 2.5]] as const) {
    context.beginPath();
    for (const [dx, dy] of [[1, 1], [1, -1]] as const) {
      context.moveTo(at[0] - 8 * dx, at[1] - 8 * dy);
      context.lineTo(at[0] + 8 * dx, at[1] + 8 * dy);
    }
    context.setLineDash([]);
    context.lineWidth = width;
    context.strokeStyle = line;
    context.stroke();
  }
}

function ordinal(k: number): string {
  return `${k}${k === 1 ? 'st' : k === 2 ? 'nd' : k === 3 ? 'rd' : 'th'}`;
}
