// Units as people write them: the recordings have m/s^2.

const RAISED = { "^2": "²", "^3": "³", "^4": "⁴" };

export const pretty = (unit) => unit.replace(/\^[234]/g, (power) => RAISED[power]);
