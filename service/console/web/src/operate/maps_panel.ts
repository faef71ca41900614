// The mounted maps: versions, which one serves, where they answer; swap and roll back for those who may.
import type { MapEntry } from '../contract';
import { button, element, facts } from '../element';
import { count } from '../numbers';
import type { Service } from '../service';

export interface MapsActions {
  /** The version that serves has changed: show it. */
  served: (entry: MapEntry) => void;
  coverage: (shows: boolean) => void;
}

export class MapsPanel {
  readonly element = element('div', { class: 'panel' });
  readonly #told = element('div', { class: 'told', role: 'status' });
  #coverage = false;

  constructor(readonly service: Service, readonly actions: MapsActions) {}

  show(entries: MapEntry[]): void {
    const coverage = button('Show where maps can answer', () => {
      this.#coverage = !this.#coverage;
      coverage.setAttribute('aria-pressed', String(this.#coverage));
      this.actions.coverage(this.#coverage);
    }, { 'aria-pressed': String(this.#coverage) });
    this.element.replaceChildren(
      element('div', { class: 'row' }, coverage),
      this.#told,
      ...entries.map((entry) => this.#map(entry)),
    );
  }

  #map(entry: MapEntry): HTMLElement {
    const versions = element('ul', { class: 'versions' });
    entry.versions.forEach((version, k) => {
      const serves = version === entry.version;
      const newerServes = entry.versions.indexOf(entry.version) < k;
      versions.append(
        element(
          'li',
          { class: serves ? 'serves' : '' },
          element('code', {}, version),
          serves
            ? element('span', { class: 'tag' }, 'serves')
            : button(newerServes ? 'Roll back' : 'Swap in', () => {
                void this.#serve(entry, version);
              }, { class: 'small' }),
        ),
      );
    });
    return element(
      'section',
      {},
      element('h2', {}, entry.name),
      facts([
        ['places', count(entry.places)],
        ['views', count(entry.views)],
        ['streets', count(entry.streets)],
        ['every', `${entry.spacing_m} m`],
        ['made', new Date(entry.made_at).toLocaleString()],
        ['georeferenced', entry.georeferenced ? 'yes' : 'no'],
        ['licence', entry.licence === '' ? '–' : entry.licence],
      ]),
      element('h3', {}, 'Versions, the newest first'),
      versions,
    );
  }

  async #serve(entry: MapEntry, version: string): Promise<void> {
    try {
      const served = await this.service.serve(entry.name, version);
      this.#told.className = 'told good';
      this.#told.textContent = `${served.name} ${served.version} serves now.`;
      this.actions.served(served);
    } catch (error) {
      this.#told.className = 'told bad';
      this.#told.textContent = error instanceof Error ? error.message : String(error);
    }
  }
}
