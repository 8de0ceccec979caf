// The file of a policy for this page, which `python -m cassie_mjx.export policy=NAME web=FOLDER` writes.

export const FORMAT = "cassie-mjx policy for the web", VERSION = 3;

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
      gru: network.gru && mapped(network.gru, unpacked),
    },
    reference: {qpos: reference.qpos, qvel: reference.qvel, strideLength: reference.stride_length_m},
  };
}

function mapped(object, change) {
  return Object.fromEntries(Object.entries(object).map(([name, value]) => [name, change(value)]));
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
  const observed = observation.place.length, widths = network.layers.map(({bias}) => bias.length);
  const inputs = [network.mean, network.std, observation.age].every(({length}) => length === observed);
  if (!inputs || !fits(network, observed)) {
    throw new Error("the sizes of its network do not fit together");
  }
  if (widths.at(-1) !== robot.joints.length) throw new Error("it does not drive each joint");
  if (!reference.qpos.length || reference.qpos.length !== reference.qvel.length) {
    throw new Error("its reference motion has no samples, or not as many velocities");
  }
  return policy;
}

// Whether the arrays of a network that is given `observed` numbers have the sizes of one another.
function fits({gru, layers}, observed) {
  const carried = gru?.recurrent_bias.length ?? observed, gates = 3 * carried;
  const widths = [carried, ...layers.map(({bias}) => bias.length)];
  const remembers =
    !gru ||
    (gru.kernel.length === observed * gates && gru.recurrent.length === carried * gates && gru.bias.length === gates);
  return remembers && layers.every(({weight}, i) => weight.length === widths[i] * widths[i + 1]);
}
