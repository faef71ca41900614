// Rates from Prometheus' counters: two looks, and the seconds between them.

export interface Look {
  at: number;
  answers: Map<string, number>;
  working: number;
  waiting: number;
  capacity: number;
}

const LINE = /^(streetfix_\w+)(?:\{([^}]*)\})? ([0-9.eE+-]+)$/;

export function lookAt(metrics: string, at: number): Look {
  const look: Look = { at, answers: new Map(), working: 0, waiting: 0, capacity: 0 };
  for (const line of metrics.split('\n')) {
    const [, name, labels = '', value = '0'] = LINE.exec(line) ?? [];
    if (name === 'streetfix_answers_total') {
      const status = /status="(\w+)"/.exec(labels)?.[1] ?? '';
      look.answers.set(status, (look.answers.get(status) ?? 0) + Number(value));
    }
    if (name === 'streetfix_working') look.working = Number(value);
    if (name === 'streetfix_waiting') look.waiting = Number(value);
    if (name === 'streetfix_capacity') look.capacity = Number(value);
  }
  return look;
}

/** Answers a second between two looks. */
export function rate(before: Look, now: Look): number {
  const total = (look: Look): number => [...look.answers.values()].reduce((sum, each) => sum + each, 0);
  const seconds = (now.at - before.at) / 1000;
  return seconds <= 0 ? 0 : Math.max(0, (total(now) - total(before)) / seconds); // a restart begins at zero
}
