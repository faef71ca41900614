// Rates from Prometheus' counters: the difference of two snapshots per second.

export interface Snapshot {
  at: number;
  answers: Map<string, number>;
  working: number;
  waiting: number;
  capacity: number;
}

const LINE = /^(streetfix_\w+)(?:\{([^}]*)\})? ([0-9.eE+-]+)$/;

export function snapshotOf(metrics: string, at: number): Snapshot {
  const snapshot: Snapshot = { at, answers: new Map(), working: 0, waiting: 0, capacity: 0 };
  for (const line of metrics.split('\n')) {
    const [, name, labels = '', value = '0'] = LINE.exec(line) ?? [];
    if (name === 'streetfix_answers_total') {
      const status = /status="(\w+)"/.exec(labels)?.[1] ?? '';
      snapshot.answers.set(status, (snapshot.answers.get(status) ?? 0) + Number(value));
    }
    if (name === 'streetfix_working') snapshot.working = Number(value);
    if (name === 'streetfix_waiting') snapshot.waiting = Number(value);
    if (name === 'streetfix_capacity') snapshot.capacity = Number(value);
  }
  return snapshot;
}

/** Answers per second between two snapshots. */
export function rate(before: Snapshot, now: Snapshot): number {
  const total = (snapshot: Snapshot): number => [...snapshot.answers.values()].reduce((sum, each) => sum + each, 0);
  const seconds = (now.at - before.at) / 1000;
  return seconds <= 0 ? 0 : Math.max(0, (total(now) - total(before)) / seconds); // after a restart the counters begin at 0
}
