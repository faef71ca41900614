// The answer in words and numbers, and what led to it.
import type { Answer, Explanation, Pose, Truth } from '../contract';
import { element, facts } from '../element';
import { ellipseOf } from '../map/ellipse';
import { degrees, metres, milliseconds, percent } from '../numbers';
import { ServiceError } from '../service';
import { errorOf } from '../ask/truth';
import { SeenPictures } from './seen_pictures';

const STATUS_TEXT = {
  LOCALIZED: 'Localized',
  AMBIGUOUS: 'Ambiguous',
  OUT_OF_MAP: 'Out of map',
} as const;
const STATUS_MEANING = {
  LOCALIZED: 'Act on it.',
  AMBIGUOUS: 'In the map, but not sure where: there is no pose. Look at the hypotheses; a prior or more frames decide.',
  OUT_OF_MAP: 'The map does not show what the pictures do. There is no pose; do not use the hypotheses as one.',
} as const;
/** What confidence promises: a position within this of the true one. */
const WRONG_M = 1;
const STAGES = ['decode', 'fuse', 'encode', 'search', 'register'] as const;

export class AnswerPanel {
  readonly element = element('div', { class: 'panel', 'aria-live': 'polite' });
  readonly #pictures = new SeenPictures();

  constructor() {
    this.element.append(
      element(
        'div',
        { class: 'empty' },
        element('h2', {}, 'Where was this picture taken?'),
        element('p', {}, 'Click a sample pair, or drop an RGB and a depth picture with their camera. The answer is drawn on the map, and what the machine saw stands here.'),
      ),
    );
  }

  show(explanation: Explanation, rgb: Blob, truth: Truth | null, elapsedMs: number): void {
    const { answer } = explanation;
    this.#pictures.show(rgb, explanation);
    this.element.replaceChildren(
      this.#head(answer, truth),
      answer.pose === null ? this.#why(answer) : '',
      answer.pose === null ? this.#spread(answer) : this.#pose(answer, answer.pose),
      answer.hypotheses.length > (answer.pose === null ? 0 : 1) ? this.#hypotheses(answer) : '',
      element('section', {}, element('h2', {}, 'What the machine saw'), this.#pictures.element),
      this.#neighbours(answer),
      this.#times(answer, elapsedMs),
    );
  }

  fail(error: unknown): void {
    const ours = error instanceof ServiceError ? error : null;
    const told = error instanceof Error ? error.message : String(error);
    this.element.replaceChildren(
      element(
        'div',
        { class: 'problem', role: 'alert' },
        element('h2', {}, ours?.title ?? 'This cannot be asked.'),
        element('p', {}, told),
        ours === null || ours.status === 0
          ? null
          : element('p', { class: 'hint' }, [`HTTP ${ours.status}`, ours.code, ours.field && `field ${ours.field}`, ours.requestId && `request ${ours.requestId}`].filter(Boolean).join(' · ')),
      ),
    );
  }

  #head(answer: Answer, truth: Truth | null): HTMLElement {
    const error = truth === null ? null : errorOf(answer, truth);
    return element(
      'div',
      { class: `verdict ${answer.status.toLowerCase()}` },
      element('p', { class: 'status' }, STATUS_TEXT[answer.status]),
      element('p', { class: 'street' }, answer.pose === null ? 'no pose' : (answer.street?.name ?? 'in no street')),
      element('p', { class: 'meaning' }, STATUS_MEANING[answer.status]),
      element(
        'div',
        { class: 'figures' },
        figure(answer.confidence === null ? 'not calibrated' : percent(answer.confidence), 'within 1 m'),
        error === null ? null : figure(metres(error.metres), error.degrees === null ? 'from the truth' : `and ${degrees(error.degrees)} from the truth`, error.metres > WRONG_M),
      ),
    );
  }

  #why(answer: Answer): HTMLElement {
    if (answer.reasons.length === 0) {
      return element(
        'section',
        { class: 'why' },
        element('h2', {}, 'Why there is no pose'),
        element('p', {}, 'All evidence lies in the range that calibration saw. The place may be outside the map, or look like another place of it.'),
      );
    }
    const list = element('ol');
    for (const { check, evidence, remedy } of answer.reasons) {
      const away = Object.entries(evidence).map(([name, deviations]) => `${name} ${deviations > 0 ? '+' : '−'}${Math.abs(deviations).toFixed(1)} σ`);
      list.append(element('li', {}, element('b', {}, check), element('span', {}, remedy), away.length === 0 ? null : element('span', { class: 'hint' }, away.join(', '))));
    }
    return element('section', { class: 'why' }, element('h2', {}, 'What to check, the likeliest first'), list);
  }

  #spread(answer: Answer): HTMLElement {
    const rows: [string, string][] = [];
    if (answer.spread !== null) {
      const ellipse = ellipseOf(answer.spread.covariance);
      rows.push(['σ on the ground', `${metres(ellipse.major)} × ${metres(ellipse.minor)}`]);
      rows.push(['σ heading', degrees(answer.spread.heading_std_deg)]);
      rows.push(['in one of the hypotheses', percent(answer.spread.hypotheses_weight)]);
    }
    rows.push(...heightRow(answer));
    rows.push(['map', `${answer.map.name} ${answer.map.version.slice(0, 8)}`]);
    return element('section', {}, element('h2', {}, 'Where it may be'), facts(rows));
  }

  #pose(answer: Answer, pose: Pose): HTMLElement {
    const { position, heading_deg, covariance } = pose;
    const rows: [string, string][] = [
      ['x, y, z', `${position.x.toFixed(2)}, ${position.y.toFixed(2)}, ${position.z.toFixed(2)} m`],
      ['heading', degrees(heading_deg)],
    ];
    if (covariance !== null) {
      const ellipse = ellipseOf(covariance);
      rows.push(['σ on the ground', `${metres(ellipse.major)} × ${metres(ellipse.minor)}`]);
      rows.push(['σ heading', degrees((180 / Math.PI) * Math.sqrt(covariance[35] ?? 0))]);
    }
    rows.push(...heightRow(answer));
    rows.push(['map', `${answer.map.name} ${answer.map.version.slice(0, 8)}`]);
    return element('section', {}, element('h2', {}, 'Pose'), facts(rows));
  }

  #hypotheses(answer: Answer): HTMLElement {
    return element(
      'section',
      {},
      element('h2', {}, answer.pose === null ? 'Hypotheses, not confirmed' : 'Hypotheses'),
      table(
        ['', 'support', 'on the map', 'x, y', 'heading'],
        answer.hypotheses.map((each, k) => [
          `${k + 1}`,
          percent(each.share),
          percent(each.inliers),
          `${each.pose.position.x.toFixed(1)}, ${each.pose.position.y.toFixed(1)}`,
          degrees(each.pose.heading_deg),
        ]),
      ),
    );
  }

  #neighbours(answer: Answer): HTMLElement {
    const { pose } = answer;
    return element(
      'section',
      {},
      element('h2', {}, 'Most similar places'),
      table(
        ['', 'place', 'similarity', 'street', ...(pose === null ? [] : ['away'])],
        answer.neighbours.map((each, k) => [
          `n${k + 1}`,
          `${each.place}`,
          each.similarity.toFixed(3),
          each.street ?? '–',
          ...(pose === null ? [] : [metres(Math.hypot(each.position.x - pose.position.x, each.position.y - pose.position.y), 1)]),
        ]),
      ),
    );
  }

  #times(answer: Answer, elapsedMs: number): HTMLElement {
    const times = answer.timings_ms;
    const longest = Math.max(1, ...STAGES.map((stage) => times[stage]));
    const bars = element('ul', { class: 'times' });
    for (const stage of STAGES) {
      const bar = element('span', { class: 'bar', 'aria-hidden': 'true' });
      bar.style.width = `${(100 * times[stage]) / longest}%`;
      bars.append(element('li', {}, element('span', {}, stage), element('span', { class: 'track' }, bar), element('b', {}, milliseconds(times[stage]))));
    }
    return element(
      'section',
      {},
      element('h2', {}, 'Time'),
      bars,
      element('p', { class: 'hint' }, `${milliseconds(times.total)} in the service, ${milliseconds(elapsedMs)} from the click to the answer`),
    );
  }
}

function heightRow({ camera_height }: Answer): [string, string][] {
  return camera_height === null ? [] : [['camera above ground', `${metres(camera_height.height_m)}, ${camera_height.origin}`]];
}

function figure(value: string, name: string, wrong = false): HTMLElement {
  return element('div', wrong ? { class: 'wrong' } : {}, element('b', {}, value), element('span', {}, name));
}

function table(heads: string[], rows: string[][]): HTMLElement {
  return element(
    'div',
    { class: 'scroll', tabindex: '0', role: 'group', 'aria-label': heads.filter(Boolean).join(', ') },
    element(
      'table',
      {},
      element('thead', {}, element('tr', {}, ...heads.map((each) => element(each === '' ? 'td' : 'th', each === '' ? {} : { scope: 'col' }, each)))),
      element('tbody', {}, ...rows.map((row) => element('tr', {}, ...row.map((cell) => element('td', {}, cell))))),
    ),
  );
}
