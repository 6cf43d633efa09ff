//! A map of drawn streets, described once and kept for later runs.

use super::error::BenchError;
use super::scenes::street;
use placeformer_core::types::{ContentHash, ImageSize, MapName, NewReference, ReferenceFields};
use placeformer_store::{Inserted, ReadPlaces, SqliteStore, WritePlaces};
use placeformer_vision::extract::Extractor;
use placeformer_vision::image::{ImageConfig, load_tensor};
use rayon::prelude::*;
use std::ops::Range;

/// Size of drawn references.
pub const REFERENCE_SIZE: ImageSize = ImageSize {
    width: 640,
    height: 480,
};
/// References described together.
const BATCH: u64 = 8;

/// The map that [`fill_with_streets`] fills.
pub fn street_map() -> MapName {
    // Proven by the name itself, which is within the allowed letters.
    "streets"
        .parse()
        .unwrap_or_else(|_| unreachable!("a constant name of letters"))
}

/// Brings the map of drawn streets in `store` up to `count` references.
///
/// # Errors
/// Drawing, extraction or storing fails.
pub fn fill_with_streets(
    store: &SqliteStore,
    extractor: &Extractor,
    count: u64,
) -> Result<(), BenchError> {
    let map = street_map();
    let present = match store.maps()?.into_iter().find(|info| info.name == map) {
        Some(info) if info.model == *extractor.model_id() => info.references,
        Some(_) => {
            // An earlier run measured another model, whose descriptors do not compare.
            store.delete_map(&map)?;
            0
        }
        None => 0,
    };
    for from in (present..count).step_by(BATCH as usize) {
        let until = count.min(from + BATCH);
        let references = describe_streets(extractor, from..until)?;
        for stored in store.insert_many(references) {
            let _: Inserted = stored?;
        }
    }
    Ok(())
}

/// The streets of some places as references, in the order of the places.
fn describe_streets(
    extractor: &Extractor,
    places: Range<u64>,
) -> Result<Vec<NewReference>, BenchError> {
    let photos = places
        .into_par_iter()
        .map(|place| street(place, 0, REFERENCE_SIZE))
        .collect::<Result<Vec<_>, _>>()?;
    let mut images = Vec::new();
    for photo in &photos {
        let size = extractor.input_size();
        images.push(load_tensor(photo, &ImageConfig::default(), size)?);
    }
    let descriptors = extractor.extract(&images)?;
    let reference = |(descriptor, photo): (_, &Vec<u8>)| NewReference {
        map: street_map(),
        fields: ReferenceFields::default(),
        content_hash: ContentHash::of(photo),
        model: extractor.model_id().clone(),
        descriptor,
    };
    Ok(descriptors
        .into_iter()
        .zip(&photos)
        .map(reference)
        .collect())
}
