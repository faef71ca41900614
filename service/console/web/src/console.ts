// The whole page: its layout, and the messages between its parts.
import { AnswerPanel } from './answer/answer_panel';
import { CHECKING, checkFocalLength, needsCheck, textOf, withFocalFactor } from './query/focal_length';
import { QueryPanel } from './query/query_panel';
import { bodyFrom, requestFrom, type Query } from './query/query';
import { samplesOfMap } from './query/samples_of_map';
import { cloudFrom, placesFrom, queryPointsFrom } from './binary';
import type { Answer, LocalizeRequest, MapEntry, SamplePair } from './contract';
import { button, element } from './element';
import iconAddress from './icon.svg';
import { Legend } from './map/legend';
import { MapView } from './map/map_view';
import { LivePanel } from './operate/live_panel';
import { MapsPanel } from './operate/maps_panel';
import { Service, ServiceError } from './service';
import { Tabs } from './tabs';
import { Theme } from './theme';

const CLOUD_POINTS = 2_000_000;
const REFRESH_MS = 10_000;

export class ConsolePage {
  readonly element: HTMLElement;
  readonly #service = new Service();
  readonly #map = new MapView();
  readonly #legend = new Legend();
  readonly #answer = new AnswerPanel();
  readonly #query: QueryPanel;
  readonly #maps: MapsPanel;
  readonly #live: LivePanel;
  readonly #tabs: Tabs;
  readonly #theme: Theme;
  readonly #choice = element('select', { 'aria-label': 'Map' });
  readonly #state = element('p', { class: 'state', role: 'status' });
  readonly #loading = element('p', { class: 'loading', role: 'status' });
  readonly #turn: HTMLButtonElement;
  readonly #all: HTMLButtonElement;
  #entries: MapEntry[] = [];
  #samples: SamplePair[] = [];
  #shown: MapEntry | null = null;
  #queries = 0;

  constructor() {
    this.#query = new QueryPanel(this.#service, {
      send: (query) => { void this.#localize(query); },
      drawsPrior: (draws) => { this.#map.drawsPrior = draws; this.#nameTurn(); },
      priorChanged: (prior) => { this.#map.prior.prior = prior; this.#map.changed(); },
      map: () => this.#mapName(),
      prior: () => this.#map.prior.prior,
      failed: (error) => { this.#answer.fail(error); },
    });
    this.#map.onPriorDrawn = () => {
      this.#query.prior.show(this.#map.prior.prior);
      this.#query.prior.draw.click(); // one prior is drawn, then dragging moves the map again
    };
    this.#maps = new MapsPanel(this.#service, {
      served: () => { void this.#refresh(); },
      coverage: (shows) => { void this.#showCoverage(shows); },
    });
    this.#live = new LivePanel(this.#service, (position) => { this.#map.showAt(position.x, position.y); });
    this.#tabs = new Tabs([
      { name: 'Query', content: this.#query.element },
      { name: 'Maps', content: this.#maps.element },
      { name: 'Live', content: this.#live.element },
    ], (name) => {
      if (name === 'Live') this.#live.start();
      else this.#live.stop();
    });
    this.#turn = button('3D', () => { this.#turnMap(); }, { 'aria-pressed': 'false', title: 'From above or in 3D (3)' });
    this.#all = button('⁙', () => {
      const draws = this.#all.getAttribute('aria-pressed') !== 'true';
      this.#all.setAttribute('aria-pressed', String(draws));
      this.#map.drawsAll = draws;
    }, { 'aria-pressed': 'false', 'aria-label': 'Draw every point, also while the map moves', title: 'Draw every point, also while the map moves' });
    this.#map.element.addEventListener('turn', () => { this.#turnMap(); });
    this.#choice.addEventListener('change', () => { void this.#showMap(this.#choice.value); });
    this.#theme = new Theme((shade) => { this.#map.shade = shade; this.#legend.shade = shade; });
    this.element = this.#arranged();
    this.#takeDrops();
  }

  async start(): Promise<void> {
    this.#theme.start();
    await Promise.all([this.#refresh(), this.#showSamples()]);
    window.setInterval(() => {
      if (!document.hidden) void this.#refresh();
    }, REFRESH_MS);
  }

  #arranged(): HTMLElement {
    const key = element('input', { type: 'password', id: 'key', autocomplete: 'off', placeholder: 'API key', 'aria-label': 'API key, kept only in this tab' });
    key.value = this.#service.key;
    key.addEventListener('change', () => {
      this.#service.key = key.value.trim();
      void this.#refresh();
      void this.#showSamples();
    });
    const zoom = (label: string, name: string, factor: number): HTMLButtonElement =>
      button(label, () => { this.#map.zoomBy(factor); }, { 'aria-label': name, title: name });
    return element(
      'div',
      { class: 'page' },
      element(
        'header',
        {},
        element('img', { src: iconAddress, alt: '', width: '26', height: '26' }),
        element('h1', {}, 'Streetfix'),
        this.#choice,
        this.#state,
        element('div', { class: 'end' }, key, button('◐', () => { this.#theme.toggle(); }, { 'aria-label': 'Light or dark', title: 'Light or dark', class: 'quiet' })),
      ),
      element(
        'main',
        {},
        element('div', { class: 'side left' }, this.#tabs.element),
        element(
          'section',
          { class: 'map', 'aria-label': 'Map' },
          this.#map.element,
          element(
            'div',
            { class: 'tools', role: 'group', 'aria-label': 'View' },
            this.#turn,
            zoom('+', 'Zoom in', 1.5),
            zoom('−', 'Zoom out', 1 / 1.5),
            this.#all,
            button('⤢', () => { this.#map.showAll(); }, { 'aria-label': 'Show the whole map', title: 'Show the whole map (0)' }),
          ),
          this.#legend.element,
          this.#loading,
        ),
        element('section', { class: 'side right', 'aria-label': 'Answer' }, this.#answer.element),
      ),
    );
  }

  #turnMap(): void {
    this.#map.mode = this.#map.mode === 'above' ? 'around' : 'above';
    this.#nameTurn();
  }

  #nameTurn(): void {
    this.#turn.setAttribute('aria-pressed', String(this.#map.mode === 'around'));
  }

  /** Read the list of maps, and whether the shown version still serves. */
  async #refresh(): Promise<void> {
    try {
      this.#entries = await this.#service.maps();
      this.#showState('good', 'serving');
    } catch (error) {
      const ours = error instanceof ServiceError ? error : null;
      this.#showState('bad', ours?.status === 401 ? 'needs an API key' : ours?.status === 0 ? 'does not answer' : String(ours?.title ?? error));
      if (this.#shown === null) this.#answer.fail(error);
      return;
    }
    this.#maps.show(this.#entries);
    const names = this.#entries.map((entry) => entry.name);
    if ([...this.#choice.options].map((option) => option.value).join('\n') !== names.join('\n')) {
      this.#choice.replaceChildren(...names.map((name) => element('option', { value: name }, name)));
    }
    const name = this.#shown?.name ?? names[0];
    const entry = this.#entries.find((each) => each.name === name) ?? this.#entries[0];
    if (entry !== undefined && entry.version !== this.#shown?.version) await this.#showMap(entry.name);
  }

  async #showMap(name: string): Promise<void> {
    const entry = this.#entries.find((each) => each.name === name);
    if (entry === undefined) return;
    const isOther = this.#shown?.name !== name;
    this.#shown = entry;
    this.#choice.value = name;
    if (isOther) this.#offerSamples();
    const version = `${entry.name}@${entry.version}`;
    try {
      this.#loading.textContent = 'Loading the map…';
      const [streets, places] = await Promise.all([this.#service.streets(version), this.#service.places(version)]);
      if (this.#shown !== entry) return; // another map was chosen meanwhile
      this.#map.setMap(streets, placesFrom(places));
      const cloud = cloudFrom(await this.#service.cloud(version, CLOUD_POINTS));
      if (this.#isStillShown(entry)) this.#map.setCloud(cloud);
      this.#loading.textContent = '';
      this.element.dataset['ready'] = version;
    } catch (error) {
      if (this.#isStillShown(entry)) this.#shown = null; // the next refresh tries again
      this.#loading.textContent = `The map cannot be drawn: ${error instanceof Error ? error.message : String(error)}`;
    }
  }

  #isStillShown(entry: MapEntry): boolean {
    return this.#shown === entry;
  }

  async #showSamples(): Promise<void> {
    try {
      this.#samples = await this.#service.samples();
      this.#offerSamples();
    } catch (error) {
      this.#query.offer({ samples: [], otherMaps: [] });
      if (!(error instanceof ServiceError)) throw error; // `#refresh` already shows why the service does not answer
    }
  }

  #offerSamples(): void {
    if (this.#shown !== null) this.#query.offer(samplesOfMap(this.#samples, this.#shown.name));
  }

  async #showCoverage(shows: boolean): Promise<void> {
    try {
      this.#map.reachM = shows ? await this.#service.coverageReach() : 0;
    } catch (error) {
      this.#answer.fail(error);
    }
  }

  async #localize(query: Query): Promise<void> {
    const turn = ++this.#queries;
    const began = performance.now();
    this.#query.busy = true;
    try {
      const request = requestFrom(query, this.#mapName(), this.#map.prior.prior);
      const explanation = await this.#service.explain(bodyFrom(query, request));
      if (turn !== this.#queries || query.rgb === null) return; // a later query was sent meanwhile
      this.#answer.show(explanation, query.rgb.blob, query.truth, performance.now() - began);
      this.#map.showAnswer({ answer: explanation.answer, camera: request.camera, truth: query.truth }, queryPointsFrom(explanation.points));
      this.#showState('good', 'serving');
      if (needsCheck(explanation.answer)) void this.#checkFocalLength(query, request, explanation.answer, turn);
    } catch (error) {
      if (turn !== this.#queries) return;
      this.#map.clearAnswer();
      this.#answer.fail(error);
      if (error instanceof ServiceError && error.status === 0) this.#showState('bad', 'does not answer');
    } finally {
      if (turn === this.#queries) this.#query.busy = false;
    }
  }

  /** Send the query twice more, with fx and fy halved and doubled, and show the result below the answer. A later query ends it. */
  async #checkFocalLength(query: Query, request: LocalizeRequest, answer: Answer, turn: number): Promise<void> {
    this.#answer.showCheck(CHECKING);
    const check = await checkFocalLength(
      (factor) => this.#service.localize(bodyFrom(query, withFocalFactor(request, factor))),
      () => turn === this.#queries,
    );
    if (check === null) return;
    const { text, found } = textOf(answer, check);
    this.#answer.showCheck(text, found);
  }

  #mapName(): string | null {
    return this.#entries.length > 1 ? (this.#shown?.name ?? null) : null;
  }

  #showState(kind: 'good' | 'bad', text: string): void {
    this.#state.className = `state ${kind}`;
    if (this.#state.textContent !== text) this.#state.textContent = text;
  }

  /** Files may be dropped anywhere. Otherwise a file dropped beside the field would make the browser leave the page. */
  #takeDrops(): void {
    this.element.addEventListener('dragover', (event) => {
      event.preventDefault();
      this.element.classList.add('dropping');
    });
    this.element.addEventListener('dragleave', (event) => {
      if (event.relatedTarget === null) this.element.classList.remove('dropping');
    });
    this.element.addEventListener('drop', (event) => {
      event.preventDefault();
      this.element.classList.remove('dropping');
      this.#tabs.choose('Query');
      void this.#query.takeFiles([...(event.dataTransfer?.files ?? [])]);
    });
  }
}
