// The file of a policy for this page, which `python -m cassie_mjx.export policy=NAME web=FOLDER` writes.

export const FORMAT = "cassie-mjx policy for the web", VERSION = 2;

// The policy of a file's text. Throws an Error of one sentence if it is none, or of another version.
export function readPolicy(text) {
  const file = parsed(text);
  if (file?.format !== FORMAT) throw new Error("This file is no policy for this page; export one with web=FOLDER.");
  if (file.version !== VERSION) {
    throw new Error(
      `This policy's file is of version ${file.version}, and this page reads version ${VERSION} alone; export it anew.`,
    );
  }
  try {
    return checked(policyOf(file));
  } catch (error) {
    throw new Error(`This policy's file is damaged (${error.message}); export it anew.`);
  }
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return undefined;
  }
}

function policyOf(file) {
  const {network, reference} = file;
  return {
    ...file,
    network: {
      clip: network.clip,
      mean: unpacked(network.mean),
      std: unpacked(network.std),
      layers: network.layers.map(([weight, bias]) => ({weight: unpacked(weight), bias: unpacked(bias)})),
    },
    reference: {qpos: reference.qpos, qvel: reference.qvel, strideLength: reference.stride_length_m},
  };
}

// An array from its shape and its little-endian float32 numbers in base64.
function unpacked({shape, float32}) {
  const bytes = Uint8Array.from(atob(float32), (letter) => letter.charCodeAt(0));
  const count = shape.reduce((product, size) => product * size, 1);
  if (bytes.length !== 4 * count) throw new Error(`an array of ${shape.join(" x ")} has ${bytes.length} bytes`);
  const view = new DataView(bytes.buffer);
  return Float64Array.from({length: count}, (_, i) => view.getFloat32(4 * i, true));
}

function checked(policy) {
  const {network, reference, observation, robot} = policy;
  const widths = [observation.place.length, ...network.layers.map(({bias}) => bias.length)];
  const fits = network.layers.every(({weight}, i) => weight.length === widths[i] * widths[i + 1]);
  const inputs = [network.mean, network.std, observation.age].every(({length}) => length === widths[0]);
  if (!fits || !inputs) {
    throw new Error("the sizes of its network do not fit together");
  }
  if (widths.at(-1) !== robot.joints.length) throw new Error("it does not drive each joint");
  if (!reference.qpos.length || reference.qpos.length !== reference.qvel.length) {
    throw new Error("its reference motion has no samples, or not as many velocities");
  }
  return policy;
}
