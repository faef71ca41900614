// The prior in numbers, without the mouse or more exactly than by the mouse.
import type { Prior } from '../contract';
import { button, element } from '../element';

interface Field {
  name: string;
  label: string;
  unit: string;
}

const FIELDS: Field[] = [
  { name: 'x', label: 'x', unit: 'm' },
  { name: 'y', label: 'y', unit: 'm' },
  { name: 'std', label: '± (1 σ)', unit: 'm' },
  { name: 'heading', label: 'heading', unit: '°' },
];

export class PriorFields {
  readonly element: HTMLElement;
  readonly draw: HTMLButtonElement;
  readonly #inputs = new Map<string, HTMLInputElement>();

  constructor(toggled: (draws: boolean) => void, readonly changed: (prior: Prior | null) => void) {
    this.draw = button('Draw on the map', () => {
      const draws = this.draw.getAttribute('aria-pressed') !== 'true';
      this.draw.setAttribute('aria-pressed', String(draws));
      toggled(draws);
    }, { 'aria-pressed': 'false', class: 'small' });
    const clear = button('Clear', () => {
      this.show(null);
      this.changed(null);
    }, { class: 'small quiet' });
    const grid = element('div', { class: 'fields' });
    for (const field of FIELDS) {
      const input = element('input', { type: 'number', step: 'any', id: `prior-${field.name}`, placeholder: '–' });
      input.addEventListener('change', () => {
        this.changed(this.#prior());
      });
      this.#inputs.set(field.name, input);
      grid.append(
        element('label', { for: `prior-${field.name}` }, `${field.label}, ${field.unit}`, input),
      );
    }
    this.element = element('div', {}, grid, element('div', { class: 'row' }, this.draw, clear));
  }

  show(prior: Prior | null): void {
    const position = prior?.position;
    this.#set('x', position?.x);
    this.#set('y', position?.y);
    this.#set('std', position?.std_m);
    this.#set('heading', prior?.heading_deg ?? undefined);
  }

  #prior(): Prior | null {
    const [x, y, std, heading] = ['x', 'y', 'std', 'heading'].map((name) => this.#inputs.get(name)?.valueAsNumber ?? NaN);
    const prior: Prior = {};
    if (isNumber(x) && isNumber(y)) prior.position = { x, y, std_m: isNumber(std) && std > 0 ? std : 20 };
    if (isNumber(heading)) prior.heading_deg = heading;
    return Object.keys(prior).length === 0 ? null : prior;
  }

  #set(name: string, value: number | undefined): void {
    const input = this.#inputs.get(name);
    if (input) input.value = value === undefined ? '' : String(value);
  }
}

function isNumber(value: number | undefined): value is number {
  return value !== undefined && Number.isFinite(value);
}
