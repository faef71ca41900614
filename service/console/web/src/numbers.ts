// Numbers as text.

export const metres = (value: number, digits = 2): string => `${value.toFixed(digits)} m`;
export const degrees = (value: number): string => `${value.toFixed(1)}°`;
export const milliseconds = (value: number): string => `${value < 10 ? value.toFixed(1) : value.toFixed(0)} ms`;
export const count = (value: number): string => value.toLocaleString('en');

/** A probability. Only 1 becomes 100 %, and only 0 becomes 0 %. */
export function percent(share: number): string {
  const value = 100 * share;
  if (value > 99.9 && value < 100) return '> 99.9 %';
  if (value > 0 && value < 0.1) return '< 0.1 %';
  return `${value.toFixed(value > 99 || value < 1 ? 1 : 0)} %`;
}
