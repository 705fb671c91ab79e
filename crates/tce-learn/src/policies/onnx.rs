//! Policies as ONNX models, for other runtimes.
//!
//! One input, `observation` (float32 `[batch, d_s]`, in the user's units), and one output, `action` (float32
//! `[batch, d_a]`, the mean action in the user's units). The graph includes standardisation, clipping and the range of
//! the actions:
//!
//! observation → Gather (the dimensions that the network sees) → Sub mean → Div std → Clip → (MatMul → Add → activation)* → head → range → action
//!
//! The format is protobuf. A model of this kind needs only a small part of it: numbers, texts, and nested messages
//! (onnx.proto3 of ONNX 1.x; IR version 8, operators of version 13).

use std::path::Path;

use tce_nn::{Activation, NamedParameters};

use crate::error::LearnError;
use crate::mlp_policy::{Head, KEY, MlpPolicy, PolicySpec};
use crate::policy::{Policy, PolicyKind};

const IR_VERSION: u64 = 8;
const OPERATORS: u64 = 13;
const FLOAT: u64 = 1;
const INT64: u64 = 7;

/// The bytes of a model file for `policy`.
///
/// # Errors
/// If the policy has a memory of its episode: a model is a function of the observation only.
pub fn model(policy: &Policy) -> Result<Vec<u8>, LearnError> {
    let PolicyKind::Mlp(network) = policy.kind() else {
        return Err(LearnError::Policy {
            path: "ONNX".into(),
            field: "policy".into(),
            found: "one that remembers its episode".into(),
            expected: "a function of the observation".into(),
            remedy: "train another learner (`tce learn --list`), or act with the policy's own file".into(),
        });
    };
    Ok(document(&graph(network, policy)))
}

/// Writes [`model`] to `path`; the file is complete or absent.
///
/// # Errors
/// As for [`model`], and if the file cannot be written.
pub fn save(policy: &Policy, path: &Path) -> Result<(), LearnError> {
    Ok(tce_base::write_atomically(path, &model(policy)?)?)
}

/// A message under construction: its fields, concatenated.
#[derive(Clone, Debug, Default)]
struct Message(Vec<u8>);

impl Message {
    fn raw_varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    /// Adds an integer.
    fn number(mut self, field: u64, value: u64) -> Self {
        self.raw_varint(field << 3);
        self.raw_varint(value);
        self
    }

    /// Adds bytes: a text, a message, or the values of a tensor.
    fn bytes(mut self, field: u64, value: &[u8]) -> Self {
        self.raw_varint(field << 3 | 2);
        self.raw_varint(value.len() as u64);
        self.0.extend_from_slice(value);
        self
    }

    fn text(self, field: u64, value: &str) -> Self {
        self.bytes(field, value.as_bytes())
    }

    fn message(self, field: u64, value: &Message) -> Self {
        self.bytes(field, &value.0)
    }
}

/// GraphProto: nodes (1), name (2), initialisers (5), inputs (11), outputs (12).
struct Graph {
    message: Message,
    nodes: usize,
}

impl Graph {
    /// Adds a constant tensor.
    fn constant(&mut self, name: &str, shape: &[usize], kind: u64, bytes: &[u8]) {
        let tensor = shape.iter().fold(Message::default(), |m, &size| m.number(1, size as u64));
        let tensor = tensor.number(2, kind).text(8, name).bytes(9, bytes);
        self.message = std::mem::take(&mut self.message).message(5, &tensor);
    }

    fn floats(&mut self, name: &str, shape: &[usize], values: &[f32]) {
        let bytes: Vec<u8> = values.iter().flat_map(|x| x.to_le_bytes()).collect();
        self.constant(name, shape, FLOAT, &bytes);
    }

    /// Adds an operator on `inputs`; returns the name of its output.
    fn node(&mut self, operator: &str, inputs: &[&str], axis: Option<u64>) -> String {
        self.nodes += 1;
        let output = format!("{}_{}", operator.to_lowercase(), self.nodes);
        self.named(operator, inputs, axis, output)
    }

    fn named(&mut self, operator: &str, inputs: &[&str], axis: Option<u64>, output: String) -> String {
        let node = inputs.iter().fold(Message::default(), |m, input| m.text(1, input));
        let mut node = node.text(2, &output).text(3, &output).text(4, operator);
        if let Some(axis) = axis {
            // AttributeProto: name (1), integer (3), type (20) = INT.
            node = node.message(5, &Message::default().text(1, "axis").number(3, axis).number(20, 2));
        }
        self.message = std::mem::take(&mut self.message).message(1, &node);
        output
    }

    fn activation(&mut self, x: String, activation: Activation) -> String {
        match activation {
            Activation::Identity => x,
            Activation::Relu => self.node("Relu", &[&x], None),
            Activation::Tanh => self.node("Tanh", &[&x], None),
            Activation::Silu => {
                let gate = self.node("Sigmoid", &[&x], None);
                self.node("Mul", &[&x, &gate], None)
            }
        }
    }

    fn columns(&mut self, x: &str, name: &str, columns: &[usize]) -> String {
        let bytes: Vec<u8> = columns.iter().flat_map(|&c| (c as i64).to_le_bytes()).collect();
        self.constant(name, &[columns.len()], INT64, &bytes);
        self.node("Gather", &[x, name], Some(1))
    }

    fn clipped(&mut self, x: &str, name: &str, bound: f32) -> String {
        let (low, high) = (format!("{name}_low"), format!("{name}_high"));
        self.floats(&low, &[], &[-bound]);
        self.floats(&high, &[], &[bound]);
        self.node("Clip", &[x, &low, &high], None)
    }
}

/// Adds the computation of the network's inputs from an observation.
fn inputs(graph: &mut Graph, spec: &PolicySpec) -> String {
    let mut x = "observation".to_owned();
    if spec.inputs.len() != spec.observations {
        x = graph.columns(&x, "inputs", &spec.inputs);
    }
    let seen = |of: &[f32]| -> Vec<f32> { spec.inputs.iter().map(|&d| of[d]).collect() };
    graph.floats("mean", &[spec.inputs.len()], &seen(&spec.standardizer.mean));
    graph.floats("std", &[spec.inputs.len()], &seen(&spec.standardizer.std));
    x = graph.node("Sub", &[&x, "mean"], None);
    x = graph.node("Div", &[&x, "std"], None);
    match spec.clip {
        Some(bound) => graph.clipped(&x, "seen", bound),
        None => x,
    }
}

fn graph(policy: &MlpPolicy, whole: &Policy) -> Message {
    let (spec, NamedParameters { tensors, .. }) = (policy.spec(), policy.to_parameters());
    let mut graph = Graph { message: Message::default(), nodes: 0 };
    let mut x = inputs(&mut graph, spec);
    for layer in 0..=spec.hidden.len() {
        let [weight, bias] = ["weight", "bias"].map(|part| format!("{KEY}.layers.{layer}.{part}"));
        // This is a population of one: the first dimension has size 1.
        let ((shape, values), (_, biases)) = (&tensors[&weight], &tensors[&bias]);
        graph.floats(&weight, &shape[1..], values);
        graph.floats(&bias, &[biases.len()], biases);
        x = graph.node("MatMul", &[&x, &weight], None);
        x = graph.node("Add", &[&x, &bias], None);
        let last = layer == spec.hidden.len();
        x = graph.activation(x, if last { spec.output_activation } else { spec.activation });
    }
    x = match spec.head {
        Head::Mean | Head::Gaussian { .. } => graph.clipped(&x, "action", 1.0),
        Head::TanhGaussian => {
            let mean = graph.columns(&x, "means", &(0..spec.actions).collect::<Vec<_>>());
            graph.node("Tanh", &[&mean], None)
        }
    };
    if let Some(range) = whole.action_range() {
        // low + (a + 1) 0.5 (high - low), computed in the order of `ActionRange::to_own`.
        let width: Vec<f32> = range.low.iter().zip(&range.high).map(|(low, high)| high - low).collect();
        graph.floats("one", &[], &[1.0]);
        graph.floats("half", &[], &[0.5]);
        graph.floats("width", &[spec.actions], &width);
        graph.floats("low", &[spec.actions], &range.low);
        for (operator, with) in [("Add", "one"), ("Mul", "half"), ("Mul", "width"), ("Add", "low")] {
            x = graph.node(operator, &[&x, with], None);
        }
    }
    graph.named("Identity", &[&x], None, "action".to_owned());
    let message = graph.message.text(2, "policy");
    let message = message.message(11, &value("observation", spec.observations));
    message.message(12, &value("action", spec.actions))
}

/// ValueInfoProto: a float tensor `[batch, columns]`.
fn value(name: &str, columns: usize) -> Message {
    let batch = Message::default().text(2, "batch");
    let width = Message::default().number(1, columns as u64);
    let shape = Message::default().message(1, &batch).message(1, &width);
    let tensor = Message::default().number(1, FLOAT).message(2, &shape);
    Message::default().text(1, name).message(2, &Message::default().message(1, &tensor))
}

/// ModelProto: IR version (1), program (2), its version (3), graph (7), operators (8).
fn document(graph: &Message) -> Vec<u8> {
    let operators = Message::default().text(1, "").number(2, OPERATORS);
    let head = Message::default().number(1, IR_VERSION).text(2, "tce").text(3, env!("CARGO_PKG_VERSION"));
    head.message(7, graph).message(8, &operators).0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_texts_are_protobuf() {
        // The examples of protobuf's documentation: field 1 = 150, field 2 = "testing".
        assert_eq!(Message::default().number(1, 150).0, [0x08, 0x96, 0x01]);
        assert_eq!(Message::default().text(2, "testing").0, b"\x12\x07testing");
        let inner = Message::default().number(1, 150);
        assert_eq!(Message::default().message(3, &inner).0, [0x1a, 0x03, 0x08, 0x96, 0x01]);
    }
}
