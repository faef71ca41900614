// Current rates of the service, and its last answers.
import type { LastAnswer, Vector } from '../contract';
import { button, element } from '../element';
import { milliseconds, percent } from '../numbers';
import { ServiceError, type Service } from '../service';
import { snapshotOf, rate, type Snapshot } from './rates';

const EVERY_MS = 2000;
const SNAPSHOTS = 60;

export class LivePanel {
  readonly element = element('div', { class: 'panel' });
  readonly #figures = element('div', { class: 'figures' });
  readonly #chart = element('canvas', { class: 'chart', 'aria-hidden': 'true', width: '640', height: '120' });
  readonly #list = element('div', { class: 'scroll', tabindex: '0', role: 'group', 'aria-label': 'Last answers' });
  readonly #message = element('div', { class: 'message', role: 'status' });
  #snapshots: Snapshot[] = [];
  #timer = 0;

  constructor(readonly service: Service, readonly chosen: (position: Vector) => void) {
    this.element.append(
      element('section', {}, element('h2', {}, 'Now'), this.#figures, this.#chart, element('p', { class: 'hint' }, 'answers per second, the last two minutes')),
      this.#message,
      element('section', {}, element('h2', {}, 'Last answers of this process'), this.#list),
    );
  }

  start(): void {
    this.stop();
    const turn = (): void => {
      void this.#refresh().finally(() => {
        if (this.#timer !== 0) this.#timer = window.setTimeout(turn, EVERY_MS);
      });
    };
    this.#timer = window.setTimeout(turn, 0);
  }

  stop(): void {
    window.clearTimeout(this.#timer);
    this.#timer = 0;
  }

  async #refresh(): Promise<void> {
    try {
      const snapshot = snapshotOf(await this.service.metrics(), performance.now());
      this.#snapshots = [...this.#snapshots.slice(1 - SNAPSHOTS), snapshot];
      this.#showFigures(snapshot);
      this.#list.replaceChildren(this.#table(await this.service.lastAnswers()));
      this.#message.textContent = '';
    } catch (error) {
      const forbidden = error instanceof ServiceError && error.status === 403;
      this.#message.className = 'message bad';
      this.#message.textContent = forbidden
        ? 'The last answers contain positions of robots. Enter an operator’s key above (streetfix keys --operator).'
        : error instanceof Error ? error.message : String(error);
    }
  }

  #showFigures(snapshot: Snapshot): void {
    const before = this.#snapshots.at(-2) ?? snapshot;
    const of = (status: string): string => String(snapshot.answers.get(status) ?? 0);
    const rows: [string, string][] = [
      [rate(before, snapshot).toFixed(1), 'answers per second'],
      [`${snapshot.working}`, 'running'],
      [`${snapshot.waiting} of ${snapshot.capacity}`, 'waiting'],
      [of('LOCALIZED'), 'localized'],
      [of('AMBIGUOUS'), 'ambiguous'],
      [of('OUT_OF_MAP'), 'out of map'],
    ];
    this.#figures.replaceChildren(...rows.map(([value, name]) => element('div', {}, element('b', {}, value), element('span', {}, name))));
    this.#drawChart();
  }

  #drawChart(): void {
    const context = this.#chart.getContext('2d');
    if (context === null) return;
    const { width, height } = this.#chart;
    const rates = this.#snapshots.slice(1).map((snapshot, k) => rate(this.#snapshots[k] ?? snapshot, snapshot));
    const most = Math.max(1, ...rates);
    context.clearRect(0, 0, width, height);
    context.fillStyle = getComputedStyle(this.#chart).color;
    const step = width / (SNAPSHOTS - 1);
    rates.forEach((each, k) => {
      const tall = Math.max(2, (each / most) * (height - 6));
      context.fillRect(width - (rates.length - k) * step, height - tall, step - 2, tall);
    });
  }

  #table(answers: LastAnswer[]): HTMLElement {
    if (answers.length === 0) return element('p', { class: 'hint' }, 'None yet.');
    const rows = answers.map((answer) =>
      element(
        'tr',
        {},
        element('td', {}, new Date(answer.at).toLocaleTimeString([], { hour12: false })),
        element('td', {}, element('span', { class: `dot ${answer.status.toLowerCase()}`, title: answer.status }), this.#street(answer)),
        element('td', {}, answer.confidence === null ? '–' : percent(answer.confidence)),
        element('td', {}, milliseconds(answer.total_ms)),
      ),
    );
    const heads = ['time', 'street', 'confidence', 'duration'];
    return element(
      'table',
      {},
      element('thead', {}, element('tr', {}, ...heads.map((each) => element('th', { scope: 'col' }, each)))),
      element('tbody', {}, ...rows),
    );
  }

  /** A button that shows the position on the map. An answer that is not LOCALIZED has no position. */
  #street(answer: LastAnswer): HTMLElement {
    const { position } = answer;
    if (position === null) return element('span', {}, 'no pose');
    const street = answer.street ?? 'no street';
    return button(street, () => { this.chosen(position); }, { class: 'link', 'aria-label': `Show answer ${answer.number}, ${street}, on the map` });
  }
}
