// Tabs by the ARIA pattern: arrow keys change between them.
import { element } from './element';

interface Tab {
  name: string;
  content: HTMLElement;
}

export class Tabs {
  readonly element: HTMLElement;
  readonly #buttons: HTMLButtonElement[];

  constructor(readonly tabs: Tab[], readonly chosen: (name: string) => void) {
    this.#buttons = tabs.map(({ name }, k) => {
      const made = element('button', { type: 'button', role: 'tab', id: `tab-${name}`, 'aria-controls': `panel-${name}` }, name);
      made.addEventListener('click', () => { this.choose(name); });
      made.addEventListener('keydown', (event) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
        if (step === undefined) return;
        const next = tabs[(k + step + tabs.length) % tabs.length];
        if (next) this.choose(next.name);
        this.#buttons[(k + step + tabs.length) % tabs.length]?.focus();
      });
      return made;
    });
    this.element = element('div', { class: 'tabs' }, element('div', { role: 'tablist', 'aria-label': 'Panels' }, ...this.#buttons));
    for (const { name, content } of tabs) {
      content.id = `panel-${name}`;
      content.setAttribute('role', 'tabpanel');
      content.setAttribute('aria-labelledby', `tab-${name}`);
      this.element.append(content);
    }
    this.#show(tabs[0]?.name ?? '');
  }

  choose(name: string): void {
    this.#show(name);
    this.chosen(name);
  }

  #show(name: string): void {
    this.tabs.forEach((tab, k) => {
      tab.content.hidden = tab.name !== name;
      this.#buttons[k]?.setAttribute('aria-selected', String(tab.name === name));
      if (this.#buttons[k]) this.#buttons[k].tabIndex = tab.name === name ? 0 : -1;
    });
  }
}
