// What the service does now: rates, and its last answers.
import type { LastAnswer, Vector } from '../contract';
import { button, element } from '../element';
import { milliseconds, percent } from '../numbers';
import { ServiceError, type Service } from '../service';
import { lookAt, rate, type Look } from './rates';

const EVERY_MS = 2000;
const LOOKS = 60;

export class LivePanel {
  readonly element = element('div', { class: 'panel' });
  readonly #figures = element('div', { class: 'figures' });
  readonly #chart = element('canvas', { class: 'chart', 'aria-hidden': 'true', width: '640', height: '120' });
  readonly #list = element('div', { class: 'scroll', tabindex: '0', role: 'group', 'aria-label': 'Last answers' });
  readonly #told = element('div', { class: 'told', role: 'status' });
  #looks: Look[] = [];
  #timer = 0;

  constructor(readonly service: Service, readonly chosen: (position: Vector) => void) {
    this.element.append(
      element('section', {}, element('h2', {}, 'Now'), this.#figures, this.#chart, element('p', { class: 'hint' }, 'answers a second, the last two minutes')),
      this.#told,
      element('section', {}, element('h2', {}, 'Last answers of this process'), this.#list),
    );
  }

  start(): void {
    this.stop();
    const turn = (): void => {
      void this.#look().finally(() => {
        if (this.#timer !== 0) this.#timer = window.setTimeout(turn, EVERY_MS);
      });
    };
    this.#timer = window.setTimeout(turn, 0);
  }

  stop(): void {
    window.clearTimeout(this.#timer);
    this.#timer = 0;
  }

  async #look(): Promise<void> {
    try {
      const look = lookAt(await this.service.metrics(), performance.now());
      this.#looks = [...this.#looks.slice(1 - LOOKS), look];
      this.#showFigures(look);
      this.#list.replaceChildren(this.#table(await this.service.lastAnswers()));
      this.#told.textContent = '';
    } catch (error) {
      const forbidden = error instanceof ServiceError && error.status === 403;
      this.#told.className = 'told bad';
      this.#told.textContent = forbidden
        ? 'The last answers say where robots are: enter an operator’s key above (streetfix keys --operator).'
        : error instanceof Error ? error.message : String(error);
    }
  }

  #showFigures(look: Look): void {
    const before = this.#looks.at(-2) ?? look;
    const of = (status: string): string => String(look.answers.get(status) ?? 0);
    const rows: [string, string][] = [
      [rate(before, look).toFixed(1), 'answers a second'],
      [`${look.working}`, 'at work'],
      [`${look.waiting} of ${look.capacity}`, 'waiting'],
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
    const rates = this.#looks.slice(1).map((look, k) => rate(this.#looks[k] ?? look, look));
    const most = Math.max(1, ...rates);
    context.clearRect(0, 0, width, height);
    context.fillStyle = getComputedStyle(this.#chart).color;
    const step = width / (LOOKS - 1);
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
    const heads = ['at', 'street', 'sure', 'took'];
    return element(
      'table',
      {},
      element('thead', {}, element('tr', {}, ...heads.map((each) => element('th', { scope: 'col' }, each)))),
      element('tbody', {}, ...rows),
    );
  }

  /** Pressed, the map shows the place. An answer that is not localized has none. */
  #street(answer: LastAnswer): HTMLElement {
    const { position } = answer;
    if (position === null) return element('span', {}, 'no pose');
    const street = answer.street ?? 'no street';
    return button(street, () => { this.chosen(position); }, { class: 'link', 'aria-label': `Show answer ${answer.number}, ${street}, on the map` });
  }
}
