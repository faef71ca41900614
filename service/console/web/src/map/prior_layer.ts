// A prior drawn with the mouse: press at the assumed position, drag to its standard deviation.
import type { Prior } from '../contract';
import type { Overlay } from './overlay';
import type { Palette } from './palette';

const SMALLEST_M = 1;

export class PriorLayer {
  prior: Prior | null = null;

  begin(x: number, y: number): void {
    this.prior = { ...this.prior, position: { x: round(x), y: round(y), std_m: SMALLEST_M } };
  }

  drag(x: number, y: number): void {
    const position = this.prior?.position;
    if (!position) return;
    position.std_m = round(Math.max(SMALLEST_M, Math.hypot(x - position.x, y - position.y)));
  }

  draw(overlay: Overlay, palette: Palette, groundZ: number): void {
    const position = this.prior?.position;
    if (!position) return;
    const ring = Array.from({ length: 64 }, (_, k) => {
      const turn = (2 * Math.PI * k) / 64;
      return { x: position.x + position.std_m * Math.cos(turn), y: position.y + position.std_m * Math.sin(turn), z: groundZ };
    });
    overlay.path(ring, { line: palette.prior, fill: palette.priorFill, width: 2, dash: [6, 5] }, true);
    const at = overlay.at(position.x, position.y, groundZ);
    if (at === null) return;
    overlay.dot(at, 4, { line: palette.halo, fill: palette.prior, width: 2 });
    const top = overlay.at(position.x, position.y + position.std_m, groundZ) ?? at;
    overlay.label(`prior ±${position.std_m} m`, [top[0], top[1] - 12], palette.prior, palette.halo, true);
  }
}

function round(metres: number): number {
  return Math.round(100 * metres) / 100;
}
