// Legend of the cloud's colours.
import { element } from '../element';
import { COLOURS, HEIGHTS_M, type Shade } from './cloud_points';

export class Legend {
  readonly #bar = element('span', { class: 'ramp', 'aria-hidden': 'true' });
  readonly element = element(
    'div',
    { class: 'legend' },
    element('span', {}, 'height'),
    element('span', {}, '0'),
    this.#bar,
    element('span', {}, `${HEIGHTS_M.at(-1) ?? 0} m`),
  );

  set shade(shade: Shade) {
    const last = HEIGHTS_M.at(-1) ?? 1;
    const stops = COLOURS[shade].map((colour, k) => `${colour} ${(100 * Math.sqrt((HEIGHTS_M[k] ?? 0) / last)).toFixed(0)}%`);
    this.#bar.style.background = `linear-gradient(90deg, ${stops.join(', ')})`;
  }
}
