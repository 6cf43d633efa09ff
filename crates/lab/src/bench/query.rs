//! The row of a whole query.

use super::baselines;
use super::candidates::dequantised;
use super::context::{Bench, agree};
use super::error::BenchError;
use super::measure::paired;
use super::row::BenchRow;
use super::scenes::{RerankScene, photo, unit_vector};
use super::search::NEAREST;
use super::streets::street_map;
use bytes::Bytes;
use placeformer_core::types::{ImageTensor, ReferenceId};
use placeformer_store::{ReadPlaces, SqliteStore};
use placeformer_vision::extract::{CandleEncoder, Encoder};
use rayon::prelude::*;

/// References of the map.
const QUERY_REFERENCES: u64 = 1_000_000;

impl Bench<'_> {
    /// A photo through the whole service at a million references, against the sum of the plain
    /// stages.
    pub(super) fn query(&self) -> Result<BenchRow, BenchError> {
        let (store, ids) = self.store_of_streets()?;
        let photo = Bytes::from(photo()?);
        // The service compares the photo with the streets, because they are nearest: the made-up
        // references have random vectors, which are far from any photo.
        let scene = self.scene_of(&photo, &store, &ids)?;
        let service = self.service(store, QUERY_REFERENCES - ids.len() as u64)?;
        let map = street_map();
        let ours = || service.query(&map, &photo);
        let reranked = ours().map_err(BenchError::Service)?;
        agree("query_1m", reranked, || {
            "the answer was not re-ranked".into()
        })?;
        let vectors: Vec<f32> = (0..QUERY_REFERENCES)
            .into_par_iter()
            .flat_map_iter(unit_vector)
            .collect();
        let plain = CandleEncoder::new(&self.weights, &self.spec)?;
        let query = unit_vector(1);
        let baseline = || -> Result<usize, BenchError> {
            let data = baselines::load_tensor(&photo, self.spec.input_size)?;
            let image = ImageTensor {
                size: self.spec.input_size,
                data,
            };
            let encoded = plain.encode(&[image])?;
            let found = baselines::nearest(&vectors, &query, NEAREST);
            Ok(encoded.len() + found.len() + baselines::rerank(&scene)?)
        };
        baseline()?;
        let times = paired(self.rounds, ours, baseline);
        let limit = self.decode_limit_ms(photo.len())
            + self.encode_limit_ms(&self.extractor.encoder_name())
            + self.search_limit_ms(QUERY_REFERENCES)
            + self.limits.candidates_ms(&scene.query, &scene.candidates);
        BenchRow::new("query_1m", "the baselines in sequence", times, limit)
    }

    /// The photo's key patches and those of the references it is compared with, in full precision.
    fn scene_of(
        &self,
        photo: &[u8],
        store: &SqliteStore,
        ids: &[ReferenceId],
    ) -> Result<RerankScene, BenchError> {
        let described = self.extractor.extract_full(&[self.tensor(photo)?])?;
        let (_, query) = described
            .into_iter()
            .next()
            .ok_or_else(|| BenchError::Setup("one image gave no descriptor".into()))?;
        let mut candidates = Vec::new();
        for id in ids {
            candidates.push(dequantised(&store.patches(*id)?));
        }
        Ok(RerankScene { query, candidates })
    }
}
