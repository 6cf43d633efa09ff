//! Just enough of ONNX to take a network's weights out of it: nodes by name, float initializers.
//!
//! The file is encoded as protocol buffers. The graph is field 7 of the model, and has nodes as
//! field 1 and initializers as field 5. Every other field is skipped by its wire type. Names and
//! values are slices of the file, so that nothing is copied before a tensor is asked for.

/// The file breaks the encoding, or lacks what was asked for.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("not a usable ONNX file: {0}")]
pub struct OnnxError(pub String);

/// Nodes and initializers of a graph.
#[derive(Debug, Default)]
pub struct Graph<'a> {
    /// The operations, in file order.
    pub nodes: Vec<Node<'a>>,
    /// The constant tensors.
    pub initializers: Vec<Initializer<'a>>,
}

/// One operation.
#[derive(Debug, Default)]
pub struct Node<'a> {
    /// Its name, such as `/encoder/layer.0/mlp/fc1/MatMul`.
    pub name: &'a str,
    /// Its operator, such as `MatMul`.
    pub op_type: &'a str,
    /// The values it reads.
    pub inputs: Vec<&'a str>,
}

/// One constant tensor.
#[derive(Debug, Default)]
pub struct Initializer<'a> {
    /// Its name.
    pub name: &'a str,
    /// Its shape.
    pub dims: Vec<usize>,
    data_type: u64,
    raw: &'a [u8],
    external: bool,
}

impl Initializer<'_> {
    /// Its values, row-major.
    ///
    /// # Errors
    /// They are no 32-bit floats, they lie in another file, or they are not as many as the shape
    /// says.
    pub fn floats(&self) -> Result<Vec<f32>, OnnxError> {
        const FLOAT: u64 = 1;
        let expected = self
            .dims
            .iter()
            .try_fold(4usize, |bytes, &dim| bytes.checked_mul(dim));
        if self.data_type != FLOAT || self.external || Some(self.raw.len()) != expected {
            let kind = self.data_type;
            let bytes = self.raw.len();
            let reason = format!(
                "{} {:?} has type {kind} and {bytes} bytes in place",
                self.name, self.dims
            );
            return Err(OnnxError(reason));
        }
        Ok(self
            .raw
            .chunks_exact(4)
            .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
            .collect())
    }
}

/// Reads the graph of an ONNX file.
///
/// # Errors
/// The file is truncated, is not encoded as ONNX is, or holds no graph.
pub fn parse(file: &[u8]) -> Result<Graph<'_>, OnnxError> {
    let mut graph = None;
    each_field(file, |number, value| {
        if let (7, Value::Bytes(bytes)) = (number, value) {
            graph = Some(parse_graph(bytes)?);
        }
        Ok(())
    })?;
    graph.ok_or_else(|| OnnxError("it holds no graph".into()))
}

fn parse_graph(bytes: &[u8]) -> Result<Graph<'_>, OnnxError> {
    let mut graph = Graph::default();
    each_field(bytes, |number, value| {
        match (number, value) {
            (1, Value::Bytes(bytes)) => graph.nodes.push(parse_node(bytes)?),
            (5, Value::Bytes(bytes)) => graph.initializers.push(parse_tensor(bytes)?),
            _ => {}
        }
        Ok(())
    })?;
    Ok(graph)
}

fn parse_node(bytes: &[u8]) -> Result<Node<'_>, OnnxError> {
    let mut node = Node::default();
    each_field(bytes, |number, value| {
        match (number, value) {
            (1, Value::Bytes(bytes)) => node.inputs.push(text(bytes)?),
            (3, Value::Bytes(bytes)) => node.name = text(bytes)?,
            (4, Value::Bytes(bytes)) => node.op_type = text(bytes)?,
            _ => {}
        }
        Ok(())
    })?;
    Ok(node)
}

fn parse_tensor(bytes: &[u8]) -> Result<Initializer<'_>, OnnxError> {
    let mut tensor = Initializer::default();
    each_field(bytes, |number, value| {
        match (number, value) {
            (1, Value::Integer(dim)) => tensor.dims.push(dim as usize),
            // Repeated integers may also come packed into one field.
            (1, Value::Bytes(mut packed)) => {
                while !packed.is_empty() {
                    tensor.dims.push(varint(&mut packed)? as usize);
                }
            }
            (2, Value::Integer(data_type)) => tensor.data_type = data_type,
            (8, Value::Bytes(bytes)) => tensor.name = text(bytes)?,
            (9, Value::Bytes(bytes)) => tensor.raw = bytes,
            (14, Value::Integer(location)) => tensor.external = location != 0,
            _ => {}
        }
        Ok(())
    })?;
    Ok(tensor)
}

/// The value of one field, by its wire type.
enum Value<'a> {
    Integer(u64),
    Bytes(&'a [u8]),
    Other,
}

/// Calls `visit` with the number and value of every field of a message.
fn each_field<'a>(
    mut rest: &'a [u8],
    mut visit: impl FnMut(u64, Value<'a>) -> Result<(), OnnxError>,
) -> Result<(), OnnxError> {
    while !rest.is_empty() {
        let key = varint(&mut rest)?;
        let value = match key & 7 {
            0 => Value::Integer(varint(&mut rest)?),
            1 => take(&mut rest, 8).map(|_| Value::Other)?,
            2 => {
                let length = varint(&mut rest)?;
                Value::Bytes(take(&mut rest, length)?)
            }
            5 => take(&mut rest, 4).map(|_| Value::Other)?,
            wire => return Err(OnnxError(format!("wire type {wire} is not in use"))),
        };
        visit(key >> 3, value)?;
    }
    Ok(())
}

fn take<'a>(rest: &mut &'a [u8], length: u64) -> Result<&'a [u8], OnnxError> {
    let split = usize::try_from(length)
        .ok()
        .and_then(|length| rest.split_at_checked(length));
    let (head, tail) = split.ok_or_else(|| OnnxError("it is truncated".into()))?;
    *rest = tail;
    Ok(head)
}

fn varint(rest: &mut &[u8]) -> Result<u64, OnnxError> {
    let mut value = 0;
    for shift in (0..64).step_by(7) {
        let byte = take(rest, 1)?[0];
        value |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return Ok(value);
        }
    }
    Err(OnnxError("an integer has no end".into()))
}

fn text(bytes: &[u8]) -> Result<&str, OnnxError> {
    std::str::from_utf8(bytes).map_err(|_| OnnxError("a name is not UTF-8".into()))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A length-delimited field.
    pub fn field(number: u8, bytes: &[u8]) -> Vec<u8> {
        let mut out = vec![number << 3 | 2];
        let mut length = bytes.len();
        while length >= 0x80 {
            out.push(length as u8 | 0x80);
            length >>= 7;
        }
        out.push(length as u8);
        out.extend_from_slice(bytes);
        out
    }

    /// An initializer of f32 values.
    pub fn initializer(name: &str, dims: &[u8], values: &[f32]) -> Vec<u8> {
        let dims: Vec<u8> = dims.iter().flat_map(|&dim| [8, dim]).collect();
        let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        field(
            5,
            &[dims, vec![16, 1], field(8, name.as_bytes()), field(9, &raw)].concat(),
        )
    }

    /// A MatMul node.
    pub fn matmul(name: &str, inputs: &[&str]) -> Vec<u8> {
        let inputs: Vec<u8> = inputs
            .iter()
            .flat_map(|input| field(1, input.as_bytes()))
            .collect();
        field(
            1,
            &[inputs, field(3, name.as_bytes()), field(4, b"MatMul")].concat(),
        )
    }

    fn sample() -> Vec<u8> {
        let graph = [
            initializer("w", &[2, 1], &[1.5, -2.0]),
            matmul("/fc/MatMul", &["x", "w"]),
        ]
        .concat();
        [vec![8, 7], field(7, &graph)].concat()
    }

    #[test]
    fn nodes_and_initializers_are_found() {
        let file = sample();
        let graph = parse(&file).unwrap();
        assert_eq!(
            (graph.nodes[0].name, graph.nodes[0].op_type),
            ("/fc/MatMul", "MatMul")
        );
        assert_eq!(graph.nodes[0].inputs, ["x", "w"]);
        assert_eq!(
            (graph.initializers[0].name, &graph.initializers[0].dims[..]),
            ("w", &[2, 1][..])
        );
        assert_eq!(graph.initializers[0].floats().unwrap(), [1.5, -2.0]);
    }

    #[test]
    fn a_tensor_with_too_few_bytes_is_refused() {
        let file = field(7, &initializer("w", &[3], &[1.0]));
        assert!(
            parse(&file).unwrap().initializers[0]
                .floats()
                .unwrap_err()
                .0
                .contains("w [3]")
        );
    }

    proptest! {
        #[test]
        fn no_input_panics(cut in 0usize..80, flip in 0usize..80, bits: u8) {
            let mut file = sample();
            let length = file.len();
            file[flip % length] ^= bits;
            file.truncate(cut.min(length));
            if let Ok(graph) = parse(&file) {
                for tensor in graph.initializers {
                    let _ = tensor.floats();
                }
            }
        }
    }
}
