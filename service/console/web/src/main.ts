import { ConsolePage } from './console';

const page = new ConsolePage();
document.querySelector('#console')?.replaceWith(page.element);
void page.start();
