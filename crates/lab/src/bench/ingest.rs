//! The rows of taking references in: all stages of an import, and the commit alone.

use super::context::Bench;
use super::error::BenchError;
use super::measure::in_turn;
use super::row::BenchRow;
use super::scenes::{RerankScene, street, unit_vector};
use super::streets::{REFERENCE_SIZE, street_map};
use bytes::Bytes;
use placeformer_core::types::{
    ContentHash, Descriptor, KeyPatches, ModelId, NewReference, ReferenceFields,
};
use placeformer_store::{SqliteStore, StoreConfig, StoreError, WritePlaces};
use placeformer_vision::extract::pack;
use std::fs::File;
use std::io::Write;
use std::path::Path;

/// Photos of one run.
const PHOTOS: u64 = 16;
/// Photos under way at once, as `import` has them.
const UNDER_WAY: usize = 4;
/// References of one run of the commit alone.
const COMMITS: usize = 64;
/// Writers that wait for their own commits at once.
const WRITERS: usize = 16;

impl Bench<'_> {
    /// Milliseconds a photo until it is durable and can be found, as `import` sends them; the
    /// baseline takes one after the other through the same stages. The limit is extraction alone:
    /// what overlaps it costs nothing.
    pub(super) fn ingest(&self) -> Result<BenchRow, BenchError> {
        let photos = (0..PHOTOS)
            .map(|place| street(place, 2, REFERENCE_SIZE).map(Bytes::from))
            .collect::<Result<Vec<_>, _>>()?;
        let store = SqliteStore::open(&self.new_folder("ingest")?, &StoreConfig::default())?;
        let service = self.service(store, 0)?;
        let plain =
            SqliteStore::open(&self.new_folder("ingest-in-turn")?, &StoreConfig::default())?;
        let tensors = photos
            .iter()
            .map(|photo| self.tensor(photo))
            .collect::<Result<Vec<_>, _>>()?;
        let [ours, plain, extraction] = in_turn(
            self.rounds,
            [
                &mut || {
                    service
                        .ingest(&street_map(), &photos, UNDER_WAY)
                        .map_err(BenchError::Service)
                },
                &mut || self.one_by_one(&plain, &photos),
                &mut || {
                    Ok(tensors
                        .chunks(1)
                        .try_for_each(|one| self.extractor.extract(one).map(drop))?)
                },
            ],
        )?
        .map(|ms| ms / PHOTOS as f64);
        BenchRow::new(
            "ingest",
            "one photo after the other",
            (ours, plain),
            extraction,
        )
    }

    fn one_by_one(&self, store: &SqliteStore, photos: &[Bytes]) -> Result<(), BenchError> {
        for photo in photos {
            for descriptor in self.extractor.extract(&[self.tensor(photo)?])? {
                store.insert(new_reference(ContentHash::of(photo), descriptor))?;
            }
        }
        Ok(())
    }

    /// Milliseconds a reference of writers that wait for their own commits but share syncs of the
    /// disk; the baseline commits one after the other, with a sync each. The limit is one file of
    /// the same bytes, synced once.
    pub(super) fn commit(&self) -> Result<BenchRow, BenchError> {
        let folder = self.new_folder("commit")?;
        let open = |name| SqliteStore::open(&folder.join(name), &StoreConfig::default());
        let shared = open("shared")?;
        let alone = open("alone")?;
        let scene = RerankScene::new(0.4);
        let news: Vec<NewReference> = scene
            .candidates
            .iter()
            .cycle()
            .take(COMMITS)
            .zip(0..)
            .map(reference_of)
            .collect();
        let bytes = news
            .iter()
            .map(|new| new.descriptor.patches.heap_bytes())
            .sum();
        let [ours, plain, limit] = in_turn(
            self.rounds,
            [
                &mut || Ok(insert_at_once(&shared, &news)?),
                &mut || {
                    Ok(news
                        .iter()
                        .try_for_each(|new| alone.insert(new.clone()).map(drop))?)
                },
                &mut || write_and_sync(&folder.join("plain"), bytes),
            ],
        )?
        .map(|ms| ms / COMMITS as f64);
        BenchRow::new("commit", "a sync for each reference", (ours, plain), limit)
    }
}

fn insert_at_once(store: &SqliteStore, news: &[NewReference]) -> Result<(), StoreError> {
    let write = |part: &[NewReference]| {
        part.iter()
            .try_for_each(|new| store.insert(new.clone()).map(drop))
    };
    std::thread::scope(|scope| {
        let writers: Vec<_> = news
            .chunks(COMMITS / WRITERS)
            .map(|part| scope.spawn(move || write(part)))
            .collect();
        writers
            .into_iter()
            .try_for_each(|writer| writer.join().unwrap_or(Err(StoreError::Closing)))
    })
}

/// Writes and syncs a file of this length.
pub(super) fn write_and_sync(path: &Path, bytes: usize) -> Result<(), BenchError> {
    let content = vec![7; bytes];
    let written = File::create(path)
        .and_then(|mut file| file.write_all(&content).and_then(|()| file.sync_all()));
    written.map_err(|source| BenchError::Io {
        path: path.to_owned(),
        source,
    })
}

fn reference_of((patches, number): (&KeyPatches, u64)) -> NewReference {
    let descriptor = Descriptor {
        global: unit_vector(number),
        pooled: vec![1.0, 0.0],
        patches: pack(patches),
    };
    new_reference(ContentHash::of(&number.to_le_bytes()), descriptor)
}

/// A reference to be stored in [`street_map`].
pub(super) fn new_reference(content_hash: ContentHash, descriptor: Descriptor) -> NewReference {
    let map = street_map();
    let model = ModelId::new("scene");
    NewReference {
        map,
        fields: ReferenceFields::default(),
        content_hash,
        model,
        descriptor,
    }
}
