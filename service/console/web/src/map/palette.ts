// Colours of the overlay. The style sheet has the colours of the page.
import type { Shade } from './cloud_points';

export interface Palette {
  paper: number;
  halo: string;
  name: string;
  street: string;
  streetFill: string;
  track: string;
  coverage: string;
  answer: string;
  answerFill: string;
  doubt: string;
  away: string;
  neighbour: string;
  truth: string;
  prior: string;
  priorFill: string;
}

export const PALETTES: Record<Shade, Palette> = {
  light: {
    paper: 0xf7f5f0,
    halo: 'rgba(255,255,255,0.92)',
    name: '#26343b',
    street: 'rgba(70,86,94,0.55)',
    streetFill: 'rgba(11,95,102,0.05)',
    track: 'rgba(214,90,40,0.75)',
    coverage: 'rgba(11,125,110,0.16)',
    answer: '#0a6f4c',
    answerFill: 'rgba(10,140,96,0.20)',
    doubt: '#9a5b00',
    away: '#b3261e',
    neighbour: '#5b3fb0',
    truth: '#c2185b',
    prior: '#0b5cad',
    priorFill: 'rgba(11,92,173,0.10)',
  },
  dark: {
    paper: 0x11171b,
    halo: 'rgba(10,14,17,0.9)',
    name: '#e4ecef',
    street: 'rgba(190,208,214,0.5)',
    streetFill: 'rgba(120,220,215,0.05)',
    track: 'rgba(255,150,92,0.8)',
    coverage: 'rgba(70,210,180,0.16)',
    answer: '#4ee0a5',
    answerFill: 'rgba(78,224,165,0.22)',
    doubt: '#ffc15e',
    away: '#ff8a80',
    neighbour: '#b9a3ff',
    truth: '#ff7eb0',
    prior: '#7cc0ff',
    priorFill: 'rgba(124,192,255,0.14)',
  },
};
