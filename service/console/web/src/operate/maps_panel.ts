// The mounted maps: versions, the serving version, coverage. Operators can swap and roll back.
import type { MapEntry } from '../contract';
import { button, element, facts } from '../element';
import { count } from '../numbers';
import type { Service } from '../service';

export interface MapsActions {
  /** The serving version has changed. */
  served: (entry: MapEntry) => void;
  coverage: (shows: boolean) => void;
}

export class MapsPanel {
  readonly element = element('div', { class: 'panel' });
  readonly #message = element('div', { class: 'message', role: 'status' });
  #coverage = false;

  constructor(readonly service: Service, readonly actions: MapsActions) {}

  show(entries: MapEntry[]): void {
    const coverage = button('Show coverage of the maps', () => {
      this.#coverage = !this.#coverage;
      coverage.setAttribute('aria-pressed', String(this.#coverage));
      this.actions.coverage(this.#coverage);
    }, { 'aria-pressed': String(this.#coverage) });
    this.element.replaceChildren(
      element('div', { class: 'row' }, coverage),
      this.#message,
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
            ? element('span', { class: 'tag' }, 'serving')
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
        ['spacing', `${entry.spacing_m} m`],
        ['built', new Date(entry.made_at).toLocaleString()],
        ['georeferenced', entry.georeferenced ? 'yes' : 'no'],
        ['licence', entry.licence === '' ? '–' : entry.licence],
      ]),
      element('h3', {}, 'Versions, newest first'),
      versions,
    );
  }

  async #serve(entry: MapEntry, version: string): Promise<void> {
    try {
      const served = await this.service.serve(entry.name, version);
      this.#message.className = 'message good';
      this.#message.textContent = `${served.name} ${served.version} is serving now.`;
      this.actions.served(served);
    } catch (error) {
      this.#message.className = 'message bad';
      this.#message.textContent = error instanceof Error ? error.message : String(error);
    }
  }
}
