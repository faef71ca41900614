// Light or dark: that of the system, until the user chooses.
import type { Shade } from './map/cloud_points';

const KEY = 'streetfix-theme';

export class Theme {
  readonly #system = matchMedia('(prefers-color-scheme: dark)');
  #chosen = localStorage.getItem(KEY);

  constructor(readonly changed: (shade: Shade) => void) {
    this.#system.addEventListener('change', () => {
      this.#apply();
    });
  }

  get shade(): Shade {
    if (this.#chosen === 'light' || this.#chosen === 'dark') return this.#chosen;
    return this.#system.matches ? 'dark' : 'light';
  }

  start(): void {
    this.#apply();
  }

  toggle(): void {
    this.#chosen = this.shade === 'dark' ? 'light' : 'dark';
    localStorage.setItem(KEY, this.#chosen);
    this.#apply();
  }

  #apply(): void {
    document.documentElement.dataset['theme'] = this.shade;
    this.changed(this.shade);
  }
}
