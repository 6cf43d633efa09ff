//! The row of giving a map another head.

use super::context::Bench;
use super::error::BenchError;
use super::ingest::{new_reference, write_and_sync};
use super::measure::in_turn;
use super::row::BenchRow;
use super::scenes::{street, unit_vector};
use super::streets::{REFERENCE_SIZE, street_map};
use placeformer_core::types::{
    ContentHash, Descriptor, GLOBAL_DIM, KeyPatches, ModelId, PatchGrid, PoolingStride,
    ScaleKeyPatches,
};
use placeformer_store::{
    HeadExchange, Inserted, NewHead, SqliteStore, StoreConfig, StoreError, WritePlaces,
};
use placeformer_vision::extract::Head;
use placeformer_vision::extract::pack;
use rayon::prelude::*;

/// References of the map.
const REFERENCES: u64 = 100_000;
/// References stored at once.
const BATCH: usize = 1_000;

impl Bench<'_> {
    /// Milliseconds until all vectors of a map come from another head, as `map rehead` does it; the
    /// baseline describes the map's images again, of which one is measured. The limit is one file
    /// of the same vectors, synced once.
    pub(super) fn rehead(&self) -> Result<BenchRow, BenchError> {
        let head = self
            .extractor
            .head()
            .ok_or_else(|| BenchError::Setup("there is no head to give".into()))?;
        let folder = self.new_folder("rehead")?;
        let store = SqliteStore::open(&folder.join("store"), &StoreConfig::default())?;
        fill(&store, head.dim())?;
        let image = self.tensor(&street(0, 0, REFERENCE_SIZE)?)?;
        let bytes = REFERENCES as usize * GLOBAL_DIM * size_of::<f32>();
        let mut turns = 0;
        let [ours, one, limit] = in_turn(
            self.rounds.min(3),
            [
                &mut || {
                    turns += 1;
                    let new = NewHead {
                        model: ModelId::new(format!("head {turns}")),
                        file: None,
                    };
                    Ok(store.replace_globals(&street_map(), new, &mut Projecting(head))?)
                },
                &mut || {
                    Ok(self
                        .extractor
                        .extract(std::slice::from_ref(&image))
                        .map(drop)?)
                },
                &mut || write_and_sync(&folder.join("plain"), bytes),
            ],
        )?;
        BenchRow::new(
            "rehead_100k",
            "extraction, times 100 000",
            (ours, one * REFERENCES as f64),
            limit,
        )
    }
}

/// A map of references with made-up vectors and a single key patch each, which a new head leaves
/// alone.
fn fill(store: &SqliteStore, pooled_dim: usize) -> Result<(), BenchError> {
    let grid = PatchGrid {
        columns: 32,
        rows: 24,
        patch_px: 14,
        stride: PoolingStride::Kernel,
    };
    let patch = ScaleKeyPatches {
        index: vec![0],
        attention: vec![1.0],
        descriptors: vec![0.5; 4],
    };
    let patches = pack(&KeyPatches {
        grid,
        dim: 4,
        scales: [patch.clone(), patch.clone(), patch],
    });
    let reference = |number: u64| {
        let random = (0..).flat_map(|part| unit_vector(number + part * REFERENCES));
        let descriptor = Descriptor {
            global: unit_vector(number),
            pooled: random.take(pooled_dim).collect(),
            patches: patches.clone(),
        };
        new_reference(ContentHash::of(&number.to_le_bytes()), descriptor)
    };
    let numbers: Vec<u64> = (0..REFERENCES).collect();
    for batch in numbers.chunks(BATCH) {
        let new = batch.par_iter().map(|&number| reference(number)).collect();
        store
            .insert_many(new)
            .into_iter()
            .try_for_each(|stored| stored.map(|_: Inserted| ()))?;
    }
    Ok(())
}

struct Projecting<'a>(&'a Head);

impl HeadExchange for Projecting<'_> {
    fn project(&mut self, pooled: &[Vec<f32>]) -> Result<Vec<Vec<f32>>, StoreError> {
        pooled
            .par_iter()
            .map(|pooled| self.0.project_stored(pooled))
            .collect::<Result<_, _>>()
            .map_err(|error| StoreError::HeadNotApplied {
                source: error.into(),
            })
    }
}
