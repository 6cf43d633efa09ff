//! The rows of the ablation table: which settings are tried along each axis.

use super::cuts::{Codec, Cut};
use crate::eval::error::EvalError;
use placeformer_core::types::{ImageSize, InvalidValue, SCALES, ScaleSet, ScoreKind};
use placeformer_vision::extract::{ExtractConfig, HeadChoice, Preset};
use placeformer_vision::rerank::RerankConfig;
use std::path::Path;

/// Settings of the run that the table varies.
#[derive(Clone, Copy)]
pub struct Base<'a> {
    /// Extraction.
    pub extract: &'a ExtractConfig,
    /// Re-ranking.
    pub rerank: &'a RerankConfig,
    /// Candidates per query.
    pub candidates: usize,
    /// Backbones beside the base's, of those whose weights are at hand.
    pub backbones: &'a [Preset],
    /// Folder of the feature cache.
    pub cache: &'a Path,
    /// Bytes of key patches held in memory.
    pub memory_bytes: u64,
    /// Greatest distance of a positive in metres.
    pub radius_m: f64,
}

/// One setting of one axis.
pub(super) struct Variant {
    /// What is varied.
    pub(super) axis: &'static str,
    /// Its value; a star marks the base setting.
    pub(super) setting: String,
    pub(super) extract: ExtractConfig,
    pub(super) rerank: RerankConfig,
    /// What is done to the extracted key patches.
    pub(super) cut: Cut,
}

/// The paper's table of patch sizes: single scales, joint scales, and sums.
const SCALE_ROWS: [&str; 12] = [
    "1",
    "2",
    "3",
    "1+2",
    "1+3",
    "2+3",
    "1+2+3",
    "1,2,3",
    "1,1+2",
    "1,2+3",
    "1+2,2+3",
    "1,1+2,2+3",
];
const TAU_ROWS: [f32; 5] = [0.0, 0.5, 1.0, 1.5, 2.0];
const CAP_ROWS: [[usize; SCALES]; 5] = [
    [50, 25, 6],
    [100, 50, 12],
    [200, 100, 25],
    [400, 200, 50],
    [usize::MAX, usize::MAX, usize::MAX],
];
/// Input sizes in patches: columns and rows of the grid.
pub(super) const SIZE_ROWS: [(u32, u32); 4] = [(16, 12), (24, 18), (32, 24), (46, 34)];
const CODEC_ROWS: [Codec; 4] = [
    Codec::INT8,
    Codec::Bits(6),
    Codec::Bits(4),
    Codec::Components(128),
];
/// Caps that keep every patch: as many as an extraction may be asked for.
pub(super) const ALL_PATCHES: [usize; SCALES] = [1 << 16; SCALES];

/// Every row; where no row of an axis is the base setting, it is added.
pub(super) fn variants(base: &Base<'_>) -> Result<Vec<Variant>, EvalError> {
    all_axes(base).map_err(|error| EvalError::Setting(error.to_string()))
}

fn all_axes(base: &Base<'_>) -> Result<Vec<Variant>, InvalidValue> {
    let extract = base.extract.effective()?;
    let headless = ExtractConfig {
        head: HeadChoice::None,
        ..extract.clone()
    };
    let mut list = VariantList {
        extract: &extract,
        headless: &headless,
        rerank: base.rerank,
        variants: Vec::new(),
    };
    list.add_scales()?;
    list.add_scores();
    list.add_codecs();
    list.add_taus_and_caps();
    list.add_input_sizes();
    list.add_exit_blocks();
    list.add_backbones(base.backbones)?;
    Ok(list.variants)
}

/// The settings of an axis, with the base's own if it is none of them.
fn with_base<T: PartialEq + Clone>(settings: impl IntoIterator<Item = T>, base: T) -> Vec<T> {
    let mut all: Vec<T> = settings.into_iter().collect();
    if !all.contains(&base) {
        all.push(base);
    }
    all
}

fn parse_scales(text: &str) -> Result<Vec<ScaleSet>, InvalidValue> {
    text.split(',').map(str::parse).collect()
}

/// The rows so far, and the base settings they vary.
struct VariantList<'a> {
    extract: &'a ExtractConfig,
    /// The same extraction without a head: every row searches the mean patch token.
    headless: &'a ExtractConfig,
    rerank: &'a RerankConfig,
    variants: Vec<Variant>,
}

impl VariantList<'_> {
    fn add_scales(&mut self) -> Result<(), InvalidValue> {
        let mut settings = Vec::new();
        for text in SCALE_ROWS {
            settings.push(parse_scales(text)?);
        }
        for scales in with_base(settings, self.rerank.scales.clone()) {
            let names: Vec<String> = scales.iter().map(ToString::to_string).collect();
            let is_base = scales == self.rerank.scales;
            let rerank = RerankConfig {
                scales,
                ..self.rerank.clone()
            };
            self.variants.push(Variant {
                axis: "scales",
                setting: starred(names.join(", "), is_base),
                extract: self.extract.clone(),
                rerank,
                cut: Cut::None,
            });
        }
        Ok(())
    }

    fn add_scores(&mut self) {
        for score in ScoreKind::ALL {
            let rerank = RerankConfig {
                score,
                ..self.rerank.clone()
            };
            let is_base = score == self.rerank.score;
            self.variants.push(Variant {
                axis: "score",
                setting: starred(score.as_str().to_owned(), is_base),
                extract: self.extract.clone(),
                rerank,
                cut: Cut::None,
            });
        }
    }

    fn add_codecs(&mut self) {
        let extract = self.extract;
        self.push("codec", "f32".into(), false, extract, Cut::FullPrecision);
        for codec in CODEC_ROWS {
            let is_base = codec == Codec::INT8;
            self.push("codec", codec.name(), is_base, extract, Cut::Codec(codec));
        }
    }

    /// Both axes are cut from one extraction that keeps every patch.
    fn add_taus_and_caps(&mut self) {
        let base = self.extract;
        let every_patch = ExtractConfig {
            tau: 0.0,
            caps: ALL_PATCHES,
            ..self.headless.clone()
        };
        for tau in with_base(TAU_ROWS, base.tau) {
            let cut = Cut::Limits {
                tau,
                caps: base.caps,
            };
            self.push("tau", tau.to_string(), tau == base.tau, &every_patch, cut);
        }
        for caps in with_base(CAP_ROWS, base.caps) {
            let name = if caps[0] == usize::MAX {
                "none".into()
            } else {
                caps.map(|cap| cap.to_string()).join(" / ")
            };
            let cut = Cut::Limits {
                tau: base.tau,
                caps,
            };
            self.push("caps", name, caps == base.caps, &every_patch, cut);
        }
    }

    fn add_input_sizes(&mut self) {
        let base = self.extract.input_size;
        let patch = self.extract.preset.geometry().patch as u32;
        let sizes = SIZE_ROWS.map(|(columns, rows)| {
            Some(ImageSize {
                width: columns * patch,
                height: rows * patch,
            })
        });
        for input_size in with_base(sizes, base) {
            let extract = ExtractConfig {
                input_size,
                ..self.headless.clone()
            };
            let name = input_size.map_or_else(|| "preset".to_owned(), |size| size.to_string());
            let is_base = input_size == base;
            self.push("input size", name, is_base, &extract, Cut::None);
        }
    }

    fn add_exit_blocks(&mut self) {
        let base = self.extract;
        let depth = base.preset.geometry().depth;
        for exit_block in with_base((depth / 2..depth).map(Some), base.exit_block) {
            let is_base = exit_block == base.exit_block;
            // The base may take its attention from another block than its tokens, and its row must
            // be the base. The other rows take both from one block.
            let attention_block = if is_base {
                base.attention_block
            } else {
                exit_block
            };
            let extract = ExtractConfig {
                exit_block,
                attention_block,
                ..self.headless.clone()
            };
            let name = exit_block.map_or_else(|| "preset".to_owned(), |block| block.to_string());
            self.push("exit block", name, is_base, &extract, Cut::None);
        }
    }

    fn add_backbones(&mut self, presets: &[Preset]) -> Result<(), InvalidValue> {
        for &preset in presets {
            let is_base = preset == self.extract.preset;
            let extract = if is_base {
                self.headless.clone()
            } else {
                // Sizes and blocks are the other preset's own; what is said of key patches stays.
                let other = ExtractConfig {
                    preset,
                    head: HeadChoice::None,
                    tau: self.extract.tau,
                    caps: self.extract.caps,
                    ..Default::default()
                };
                other.effective()?
            };
            self.push("backbone", preset.to_string(), is_base, &extract, Cut::None);
        }
        Ok(())
    }

    fn push(
        &mut self,
        axis: &'static str,
        setting: String,
        is_base: bool,
        extract: &ExtractConfig,
        cut: Cut,
    ) {
        self.variants.push(Variant {
            axis,
            setting: starred(setting, is_base),
            extract: extract.clone(),
            rerank: self.rerank.clone(),
            cut,
        });
    }
}

fn starred(setting: String, is_base: bool) -> String {
    if is_base {
        format!("{setting} *")
    } else {
        setting
    }
}
