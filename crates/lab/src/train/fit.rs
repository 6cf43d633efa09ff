//! Fitting a head without labels: a partly whitened PCA of pooled tokens.

use super::error::TrainError;
use super::pooled_cache::PooledCache;
use super::triplets::{Side, TripletSet};
use placeformer_core::progress::{Progress, Task};
use placeformer_core::types::ImageTensor;
use placeformer_vision::extract::{
    Aggregate, Covariance, Extractor, Head, NetVlad, NetVladShape, VladWords, Whitening,
    sample_tokens, whitened_head, whitened_head_of_few,
};
use placeformer_vision::image::{ImageConfig, load_tensor};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::{Path, PathBuf};

/// Images decoded together while the transformer waits, and encoded together while the decoder
/// does.
const BATCH: usize = 16;
/// Images that visual words are learnt from, evenly spread over all.
const WORD_IMAGES: usize = 256;
/// Tokens drawn from each of them.
const WORD_TOKENS: usize = 100;
/// Most images behind a PCA of vectors too long for a covariance matrix; the cost grows with its
/// cube.
const MOST_LONG_VECTORS: usize = 2048;

/// How the patch tokens of an image become one vector.
#[derive(Debug, Clone, PartialEq)]
pub enum AggregateChoice {
    /// As given: the mean, a generalised mean, or one that was learnt before.
    Given(Aggregate),
    /// A VLAD of so many visual words, which are learnt from the images first.
    Vlad {
        /// How many words.
        words: usize,
        /// Seed of the draw of tokens that they are learnt from.
        seed: u64,
    },
    /// A NetVLAD, whose projection and words are learnt from the images first.
    NetVlad {
        /// What it should be.
        shape: NetVladShape,
        /// Seed of the draw of tokens that it is learnt from.
        seed: u64,
    },
}

/// A head fitted to images.
pub struct FittedHead {
    /// The head.
    pub head: Head,
    /// Images it was fitted on.
    pub images: usize,
    /// Images that were left out because they cannot be read, with the reasons, sorted.
    pub unreadable: BTreeSet<String>,
}

/// Fits a head for `extractor` to the images of `files`.
///
/// # Errors
/// The model fails, or too few images can be read.
pub fn fit_head(
    extractor: &Extractor,
    files: &[PathBuf],
    choice: AggregateChoice,
    whitening: Whitening,
    progress: &dyn Progress,
) -> Result<FittedHead, TrainError> {
    let mut reader = Reader {
        extractor,
        whitening,
        progress,
        unreadable: BTreeSet::new(),
    };
    let (head, images) = match choice {
        AggregateChoice::Given(aggregate) => {
            if aggregate.pooled_dim(extractor.dim()) > extractor.dim() {
                let files = spread(files, MOST_LONG_VECTORS);
                reader.fit_by_vectors(&files, aggregate)?
            } else {
                reader.fit_by_covariance(files, aggregate)?
            }
        }
        AggregateChoice::Vlad { words, seed } => {
            let tokens = reader.sampled_tokens(files, seed)?;
            let words = VladWords::fit(&tokens, extractor.dim(), words, seed)?;
            let files = spread(files, MOST_LONG_VECTORS);
            reader.fit_by_vectors(&files, Aggregate::Vlad(words))?
        }
        AggregateChoice::NetVlad { shape, seed } => {
            let tokens = reader.sampled_tokens(files, seed)?;
            let netvlad = NetVlad::fit(&tokens, extractor.dim(), shape, seed)?;
            let files = spread(files, MOST_LONG_VECTORS);
            reader.fit_by_vectors(&files, Aggregate::NetVlad(Box::new(netvlad)))?
        }
    };
    Ok(FittedHead {
        head,
        images,
        unreadable: reader.unreadable,
    })
}

/// Reads images for a fit, remembering those it cannot.
struct Reader<'a> {
    extractor: &'a Extractor,
    whitening: Whitening,
    progress: &'a dyn Progress,
    unreadable: BTreeSet<String>,
}

impl Reader<'_> {
    /// Tokens of some of the images, drawn at random, `[n, dim]`.
    fn sampled_tokens(&mut self, files: &[PathBuf], seed: u64) -> Result<Vec<f32>, TrainError> {
        let dim = self.extractor.dim();
        let mut tokens = Vec::new();
        let mut number = seed;
        let sampled = spread(files, WORD_IMAGES);
        self.each_batch(&sampled, "sampling tokens", |extractor, tensors| {
            for encoded in extractor.encode(tensors)? {
                tokens.extend(sample_tokens(&encoded.tokens, dim, WORD_TOKENS, number));
                number = number.wrapping_add(1);
            }
            Ok(())
        })?;
        Ok(tokens)
    }

    /// A PCA of the covariance matrix, for vectors of a few hundred values.
    fn fit_by_covariance(
        &mut self,
        files: &[PathBuf],
        aggregate: Aggregate,
    ) -> Result<(Head, usize), TrainError> {
        let mut covariance = Covariance::new(aggregate.pooled_dim(self.extractor.dim()));
        self.each_batch(files, "describing images", |extractor, tensors| {
            for pooled in extractor.pooled_by(tensors, &aggregate)? {
                covariance.add(&pooled);
            }
            Ok(())
        })?;
        let images = covariance.count();
        let notes = self.notes(&aggregate, images);
        let backbone = self.extractor.backbone();
        let whitening = self.whitening;
        let head = whitened_head(&covariance, whitening, aggregate, backbone, notes)?;
        Ok((head, images))
    }

    /// A PCA of the vectors themselves, for those too long for a covariance matrix.
    fn fit_by_vectors(
        &mut self,
        files: &[PathBuf],
        aggregate: Aggregate,
    ) -> Result<(Head, usize), TrainError> {
        let mut vectors = Vec::new();
        self.each_batch(files, "describing images", |extractor, tensors| {
            vectors.extend(extractor.pooled_by(tensors, &aggregate)?);
            Ok(())
        })?;
        let notes = self.notes(&aggregate, vectors.len());
        let backbone = self.extractor.backbone();
        let whitening = self.whitening;
        let head = whitened_head_of_few(&vectors, whitening, aggregate, backbone, notes)?;
        Ok((head, vectors.len()))
    }

    /// How the head was made.
    fn notes(&self, aggregate: &Aggregate, images: usize) -> BTreeMap<String, String> {
        let method = format!(
            "PCA, divided by deviations to the power {}, of L2-normalised {} tokens",
            self.whitening.power(),
            aggregate.kind()
        );
        let input_size = self.extractor.input_size().to_string();
        BTreeMap::from([
            ("method".to_owned(), method),
            ("input_size".to_owned(), input_size),
            ("images".to_owned(), images.to_string()),
        ])
    }

    fn each_batch(
        &mut self,
        files: &[PathBuf],
        name: &str,
        mut visit: impl FnMut(&Extractor, &[ImageTensor]) -> Result<(), TrainError>,
    ) -> Result<(), TrainError> {
        let task = Task::begin(self.progress, name, files.len() as u64);
        for batch in files.chunks(BATCH) {
            let decoded: Vec<Result<ImageTensor, String>> = batch
                .par_iter()
                .map(|path| decode(path, self.extractor))
                .collect();
            let mut tensors = Vec::with_capacity(batch.len());
            for (path, tensor) in batch.iter().zip(decoded) {
                match tensor {
                    Ok(tensor) => tensors.push(tensor),
                    Err(reason) => {
                        let line = format!("{}: {reason}", path.display());
                        self.unreadable.insert(line);
                    }
                }
            }
            visit(self.extractor, &tensors)?;
            task.add(batch.len() as u64);
        }
        Ok(())
    }
}

fn decode(path: &Path, extractor: &Extractor) -> Result<ImageTensor, String> {
    let bytes = std::fs::read(path).map_err(|error| error.to_string())?;
    load_tensor(&bytes, &ImageConfig::default(), extractor.input_size())
        .map_err(|error| error.to_string())
}

/// At most `count` of `files`, evenly spread.
fn spread(files: &[PathBuf], count: usize) -> Vec<PathBuf> {
    let step = (files.len() as f64 / count as f64).max(1.0);
    (0..files.len().min(count))
        .map(|i| files[(i as f64 * step) as usize].clone())
        .collect()
}

/// Pooled tokens of both sides of a set, each `[images, dim]`.
#[derive(Debug, Clone, PartialEq)]
pub struct SetTokens {
    /// Of the queries.
    pub queries: Vec<f32>,
    /// Of the database.
    pub database: Vec<f32>,
}

impl SetTokens {
    /// Pools the tokens of every image of `set`, taking from `cache` what it holds.
    ///
    /// # Errors
    /// An image cannot be read, the model fails, or the cache cannot be written.
    pub fn of(
        set: &TripletSet,
        extractor: &Extractor,
        cache: &mut PooledCache,
        progress: &dyn Progress,
    ) -> Result<Self, TrainError> {
        let images = set.queries.len() + set.database.len();
        let task = Task::begin(progress, "describing images", images as u64);
        let queries = cache.pool(extractor, set.images(Side::Query), &task)?;
        let database = cache.pool(extractor, set.images(Side::Database), &task)?;
        Ok(Self { queries, database })
    }
}

/// The head that training starts from where none is given: what [`fit_head`] would make of the
/// training images with the default whitening, each of which counts once even if it is both a
/// query and a database image.
///
/// # Errors
/// There are too few images.
pub fn starting_head(
    extractor: &Extractor,
    set: &TripletSet,
    tokens: &SetTokens,
) -> Result<Head, TrainError> {
    let aggregate = extractor.aggregate().clone();
    let backbone = extractor.backbone();
    let notes = BTreeMap::new();
    let whitening = Whitening::default();
    let dim = aggregate.pooled_dim(extractor.dim());
    let rows = distinct_rows(set, tokens, dim);
    if rows.len() <= dim {
        let rows: Vec<Vec<f32>> = rows.into_iter().map(<[f32]>::to_vec).collect();
        return Ok(whitened_head_of_few(
            &rows, whitening, aggregate, backbone, notes,
        )?);
    }
    let mut covariance = Covariance::new(dim);
    for row in rows {
        covariance.add(row);
    }
    Ok(whitened_head(
        &covariance,
        whitening,
        aggregate,
        backbone,
        notes,
    )?)
}

/// The tokens of every file once, those of the database first.
fn distinct_rows<'a>(set: &TripletSet, tokens: &'a SetTokens, dim: usize) -> Vec<&'a [f32]> {
    let database = tokens.database.chunks_exact(dim);
    let all_rows = database.chain(tokens.queries.chunks_exact(dim));
    let all_files = set.database.iter().chain(&set.queries);
    let mut seen = HashSet::new();
    all_files
        .zip(all_rows)
        .filter(|(file, _)| seen.insert(*file))
        .map(|(_, row)| row)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::spots::Spots;

    #[test]
    fn a_file_on_both_sides_counts_once() {
        let paths = |names: &[&str]| names.iter().map(PathBuf::from).collect();
        let set = TripletSet {
            queries: paths(&["b", "c"]),
            database: paths(&["a", "b"]),
            positives: vec![],
            near: vec![],
            spots: Spots::default(),
        };
        let tokens = SetTokens {
            queries: vec![3.0, 4.0],
            database: vec![1.0, 2.0],
        };
        assert_eq!(distinct_rows(&set, &tokens, 1), [&[1.0], &[2.0], &[4.0]]);
    }

    #[test]
    fn files_are_spread_evenly() {
        let files: Vec<PathBuf> = (0..10).map(|i| PathBuf::from(i.to_string())).collect();
        assert_eq!(spread(&files, 3), ["0", "3", "6"].map(PathBuf::from));
        assert_eq!(spread(&files, 20), files);
    }
}
