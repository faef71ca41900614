// So many points with the library's own material and nothing else: what the console's map is compared with.
import { BufferAttribute, BufferGeometry, Color, OrthographicCamera, Points, PointsMaterial, Scene, WebGLRenderer } from 'three';

const HEADER = 56;
const bytes = await (await fetch('/v1/maps/any/cloud?points=2000000')).arrayBuffer();
const data = new DataView(bytes);
const count = data.getUint32(4, true);
const steps = [32, 40, 48].map((at) => data.getFloat64(at, true));
const records = new Uint16Array(bytes, HEADER, 4 * count);
const positions = new Float32Array(3 * count);
const colours = new Float32Array(3 * count);
const colour = new Color();
for (let k = 0; k < count; k++) {
  for (let axis = 0; axis < 3; axis++) positions[3 * k + axis] = (records[4 * k + axis] - 32768) * steps[axis];
  colour.setHSL(0.6 * (records[4 * k + 2] / 65535), 0.5, 0.5).toArray(colours, 3 * k);
}
const geometry = new BufferGeometry();
geometry.setAttribute('position', new BufferAttribute(positions, 3));
geometry.setAttribute('color', new BufferAttribute(colours, 3));
const scene = new Scene();
scene.background = new Color(0xf4f2ec);
scene.add(new Points(geometry, new PointsMaterial({ size: 1, sizeAttenuation: false, vertexColors: true })));
const renderer = new WebGLRenderer({ antialias: false });
document.body.append(renderer.domElement);
const [width, height] = new URLSearchParams(location.search).get('size').split('x').map(Number);
renderer.setSize(width, height);
const half = Number(new URLSearchParams(location.search).get('half'));
const camera = new OrthographicCamera((-half * width) / height, (half * width) / height, half, -half, -20000, 20000);

let frames = 0;
function draw() {
  camera.position.x = 0.02 * half * Math.sin(frames / 10);
  renderer.render(scene, camera);
  frames++;
  requestAnimationFrame(draw);
}
requestAnimationFrame(draw);
window.framesDrawn = () => frames;
