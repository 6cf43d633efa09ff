//! Stored outputs of the reference implementation, and comparisons with them. `tests/golden` holds
//! the files and describes them.

use placeformer_core::types::{ImageSize, ImageTensor};
use placeformer_vision::extract::{ExtractionTrace, TraceArray, TraceValues};
use safetensors::SafeTensors;
use std::collections::BTreeMap;
use std::path::Path;

/// Most that a token may deviate.
const TOKENS: f32 = 1e-3;
/// Most that an attention may deviate, as a probability.
const ATTENTION: f32 = 1e-5;
/// Most that an interpolated position may deviate.
const POSITIONS: f32 = 2e-5;
/// Least cosine of a descriptor.
const COSINE: f32 = 0.99999;

/// The bytes of a file of `tests/golden`.
pub fn stored(name: &str) -> Vec<u8> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    std::fs::read(folder.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

/// The arrays of one stored file by name.
pub struct Golden {
    pub floats: BTreeMap<String, Vec<f32>>,
    pub integers: BTreeMap<String, Vec<i64>>,
}

impl Golden {
    /// Reads the file of `image` at `size`, width and height.
    pub fn load(image: &str, size: (u32, u32)) -> Self {
        let bytes = stored(&format!("{image}_{}x{}.safetensors", size.0, size.1));
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let mut golden = Self {
            floats: BTreeMap::new(),
            integers: BTreeMap::new(),
        };
        for (name, view) in file.iter() {
            let data = view.data();
            if view.dtype() == safetensors::Dtype::I64 {
                let values = data
                    .chunks_exact(8)
                    .map(|b| i64::from_le_bytes(b.try_into().unwrap()));
                golden.integers.insert(name.to_owned(), values.collect());
            } else {
                let values = data
                    .chunks_exact(4)
                    .map(|b| f32::from_le_bytes(b.try_into().unwrap()));
                golden.floats.insert(name.to_owned(), values.collect());
            }
        }
        golden
    }

    /// The stored pixels as the input of an extractor.
    pub fn tensor(&self, size: (u32, u32)) -> ImageTensor {
        ImageTensor {
            size: ImageSize {
                width: size.0,
                height: size.1,
            },
            data: self.floats["pixels"].clone(),
        }
    }
}

/// Compares one trace with a golden file by array name; prints and checks the largest deviation of
/// each.
pub struct Comparison<'a> {
    pub golden: &'a Golden,
    /// What is compared, for messages.
    pub label: String,
    /// Arrays compared so far.
    pub compared: usize,
}

impl Comparison<'_> {
    fn report(&mut self, name: &str, what: &str, value: f32, right: bool) {
        println!("{:28} {name:32} {what:10} {value:.3e}", self.label);
        assert!(right, "{}: {name}: {what} {value:e}", self.label);
        self.compared += 1;
    }

    /// Checks an array, if the golden file has one of its name.
    pub fn check(&mut self, array: &TraceArray) {
        let TraceValues::F32(values) = &array.values else {
            return;
        };
        let golden = self.golden;
        let name = array.name.as_str();
        if name.contains("_key") {
            return;
        }
        let Some(expected) = golden.floats.get(name) else {
            return;
        };
        let width = *array.shape.last().unwrap();
        let picked: Vec<f32> = match name.ends_with("_rows") {
            true => golden.integers["rows"]
                .iter()
                .flat_map(|&r| values[r as usize * width..][..width].to_vec())
                .collect(),
            false => values.clone(),
        };
        let worst = largest_difference(&picked, expected);
        match name {
            "pixels" => self.report(name, "max |d|", worst, worst == 0.0),
            "positions_rows" => self.report(name, "max |d|", worst, worst <= POSITIONS),
            _ if name.starts_with("cls_attention") => {
                self.report(name, "max |d|", worst, worst <= ATTENTION)
            }
            _ if name.starts_with("global") => {
                let away = 1.0 - cosine(&picked, expected);
                self.report(name, "1 - cos", away, away <= 1.0 - COSINE)
            }
            _ => self.report(name, "max |d|", worst, worst <= TOKENS),
        }
    }

    /// Checks the key patches at all scales; `tag` is the prefix of their names.
    pub fn check_keys(&mut self, trace: &ExtractionTrace, tag: &str) {
        for (scale, keys) in (1..).zip(&trace.key_patches.scales) {
            let base = format!("{tag}_key{scale}");
            let expected_index = &self.golden.integers[&format!("{base}_index")];
            let expected_attention = &self.golden.floats[&format!("{base}_attention")];
            let centres = &self.golden.floats[&format!("{base}_centre_xy")];
            assert_eq!(
                keys.index.len(),
                expected_index.len(),
                "{}: {base}: count",
                self.label
            );
            // Attention here is in multiples of heads/n, so the tolerance on probabilities grows by
            // n/heads each head.
            let multiple = trace.encoded.grid.len() as f32;
            let mut swaps = 0;
            for (i, (&index, &expected)) in keys.index.iter().zip(expected_index).enumerate() {
                let gap = (keys.attention[i] - expected_attention[i]).abs();
                assert!(
                    gap <= ATTENTION * multiple,
                    "{}: {base}: attention {i} is off by {gap:e}",
                    self.label
                );
                swaps += usize::from(index as i64 != expected);
            }
            let mut all: Vec<_> = keys.index.iter().map(|&i| i as i64).collect();
            let mut all_expected = expected_index.clone();
            all.sort_unstable();
            all_expected.sort_unstable();
            assert_eq!(
                all, all_expected,
                "{}: {base}: not the same set of patches",
                self.label
            );
            self.report(
                &format!("{base}_index"),
                "swaps",
                swaps as f32,
                swaps <= keys.index.len() / 20,
            );
            let worst = largest_difference(&keys.attention, expected_attention);
            self.report(
                &format!("{base}_attention"),
                "max |d|",
                worst,
                worst <= ATTENTION * multiple,
            );
            self.check_places(trace, scale, expected_index, centres, &base);
            self.check_descriptors(trace, scale, expected_index, &base);
        }
    }

    fn check_places(
        &mut self,
        trace: &ExtractionTrace,
        scale: usize,
        index: &[i64],
        centres: &[f32],
        base: &str,
    ) {
        let grid = trace.key_patches.grid;
        let ours: Vec<f32> = index
            .iter()
            .flat_map(|&i| grid.centre(scale, i as usize))
            .collect();
        let worst = largest_difference(&ours, centres);
        self.report(&format!("{base}_centre_xy"), "max |d|", worst, worst == 0.0);
    }

    fn check_descriptors(
        &mut self,
        trace: &ExtractionTrace,
        scale: usize,
        index: &[i64],
        base: &str,
    ) {
        let full = format!("{base}_descriptor");
        let first = format!("{base}_descriptor_first32");
        let Some((name, expected)) = [full, first]
            .into_iter()
            .find_map(|n| Some((n.clone(), self.golden.floats.get(&n)?)))
        else {
            return;
        };
        let keys = &trace.key_patches.scales[scale - 1];
        let dim = trace.key_patches.dim;
        let mut lowest = 1f32;
        for (expected, &i) in expected.chunks_exact(dim).zip(index) {
            let row = keys.index.iter().position(|&own| own as i64 == i).unwrap();
            lowest = lowest.min(cosine(&keys.descriptors[row * dim..][..dim], expected));
        }
        self.report(&name, "1 - cos", 1.0 - lowest, lowest >= COSINE);
    }
}

/// The largest difference between two values at the same index.
pub fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max)
}

/// The cosine of the angle between two vectors.
pub fn cosine(a: &[f32], b: &[f32]) -> f32 {
    let dot = |a: &[f32], b: &[f32]| {
        a.iter()
            .zip(b)
            .map(|(&a, &b)| a as f64 * b as f64)
            .sum::<f64>()
    };
    (dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()) as f32
}
