//! What this machine reaches at most, on all threads at once.

use placeformer_kernels::{Simd, peak};
use placeformer_vision::extract::mixed_int8_blocks;
use rayon::prelude::*;
use serde::Serialize;
use std::hint::black_box;
use std::time::{Duration, Instant};

/// Time per measurement.
const TIME: Duration = Duration::from_millis(300);
/// Bytes read for the bandwidth: far beyond any cache.
const BYTES: usize = 512 << 20;

/// Measured limits of the machine with all threads of the pool at work.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Limits {
    /// f32 multiply-adds, 10^9 operations a second (two per multiply-add).
    pub f32_gflops: f64,
    /// bf16 multiply-adds; absent where the CPU has none.
    pub bf16_gflops: Option<f64>,
    /// int8 multiply-adds; absent where the CPU has none.
    pub int8_gops: Option<f64>,
    /// Reading memory, 10^9 bytes a second.
    pub read_gbytes: f64,
}

impl Limits {
    /// Measures for about two seconds.
    pub fn measure(simd: Simd) -> Self {
        let giga = |per_thread: Vec<Option<f64>>| {
            per_thread
                .into_iter()
                .sum::<Option<f64>>()
                .map(|sum| sum / 1e9)
        };
        let all = |work: &(dyn Fn() -> Option<f64> + Sync)| giga(rayon::broadcast(|_| work()));
        let f32_operations = rayon::broadcast(|_| peak::f32_operations(simd, TIME));
        Self {
            f32_gflops: f32_operations.into_iter().sum::<f64>() / 1e9,
            bf16_gflops: all(&|| peak::bf16_operations(simd, TIME)),
            int8_gops: all(&|| peak::int8_operations(simd, TIME)),
            read_gbytes: read_bandwidth() / 1e9,
        }
    }

    /// What the linear layers and the attention of an encoder can reach, in 10^9 operations a
    /// second. The encoder's name tells its precision, such as `fused-bf16-avx512`. Half of
    /// attention, the scores, is computed at int8 unless there are matrix registers; the rest at
    /// bf16 where the CPU has it.
    pub(super) fn encoder_giga_operations(&self, encoder: &str, blocks: usize) -> (f64, f64) {
        let bf16 = self.bf16_gflops.unwrap_or(self.f32_gflops);
        let int8 = self.int8_gops.unwrap_or(self.f32_gflops);
        let attention = if encoder.contains("amx") {
            bf16
        } else {
            2.0 / (1.0 / int8 + 1.0 / bf16)
        };
        if encoder.contains("int8") {
            (int8, attention)
        } else if encoder.contains("mixed") {
            let coarse = mixed_int8_blocks(blocks).len() as f64 / blocks as f64;
            let layers = 1.0 / (coarse / int8 + (1.0 - coarse) / bf16);
            (layers, attention)
        } else if encoder.contains("bf16") {
            (bf16, attention)
        } else {
            (self.f32_gflops, self.f32_gflops)
        }
    }

    /// Milliseconds that reading or writing so many bytes takes.
    pub(super) fn memory_ms(&self, bytes: f64) -> f64 {
        Self::milliseconds(bytes, self.read_gbytes)
    }

    /// Milliseconds that `operations` take at `giga` operations a second.
    pub(super) fn milliseconds(operations: f64, giga: f64) -> f64 {
        operations / giga / 1e6
    }
}

/// Bytes per second over the best of five passes.
fn read_bandwidth() -> f64 {
    let words: Vec<u64> = (0..BYTES as u64 / 8).collect();
    let pass = || {
        let started = Instant::now();
        let sum: u64 = words
            .par_chunks(1 << 16)
            .map(|part| part.iter().fold(0, |sum, word| sum ^ word))
            .sum();
        black_box(sum);
        BYTES as f64 / started.elapsed().as_secs_f64()
    };
    (0..5).map(|_| pass()).fold(0.0, f64::max)
}
