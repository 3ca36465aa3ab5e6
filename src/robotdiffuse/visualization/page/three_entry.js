// What the replay page uses of three.js. three.min.js is this file, bundled:
//   npm install three@0.187.0 esbuild
//   npx esbuild three_entry.js --bundle --minify --format=iife --global-name=THREE --target=es2020
//     --legal-comments=inline --outfile=three.min.js
export {
  NeutralToneMapping, BoxGeometry, BufferAttribute, BufferGeometry, CapsuleGeometry,
  Color, CylinderGeometry, DirectionalLight, DoubleSide, FrontSide, Group, HemisphereLight,
  Matrix4, Mesh, MeshBasicMaterial, MeshPhysicalMaterial,
  MeshStandardMaterial, PMREMGenerator, PerspectiveCamera, PlaneGeometry, Points, 
  Scene, ShaderMaterial, ShadowMaterial, SphereGeometry, SRGBColorSpace, VSMShadowMap, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { RoomEnvironment } from "three/examples/jsm/environments/RoomEnvironment.js";
