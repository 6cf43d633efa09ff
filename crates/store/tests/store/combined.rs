//! A store made of parts from several.

use crate::places::{map, reference};
use crate::support::{create, fresh};
use placeformer_store::{
    CombinedStore, Damage, Footprint, Inserted, MaintainPlaces, PlaceStore, Quarantined,
    ReadPlaces, StoreError, VerifyReport,
};
use std::path::Path;
use std::sync::Arc;

/// Maintenance that finds one damaged record and does nothing else.
struct OneDamaged;

impl MaintainPlaces for OneDamaged {
    fn quarantined(&self) -> Result<Vec<Quarantined>, StoreError> {
        Ok(Vec::new())
    }

    fn drain_damage(&self) -> Damage {
        Damage {
            found: 1,
            withdrawn: Vec::new(),
        }
    }

    fn verify(&self) -> Result<VerifyReport, StoreError> {
        Ok(VerifyReport::default())
    }

    fn backup(&self, _target: &Path) -> Result<u64, StoreError> {
        Ok(0)
    }

    fn footprint(&self) -> Result<Footprint, StoreError> {
        Ok(Footprint::default())
    }
}

#[test]
fn every_call_goes_to_its_part() {
    let (_old_directory, old) = fresh();
    let (_new_directory, new) = fresh();
    let city = map("city");
    let there = create(&old, reference(&city, 1));
    let old = Arc::new(old);
    let new = Arc::new(new);
    let combined = CombinedStore {
        writing: new.clone(),
        maintenance: Arc::new(OneDamaged),
        ..CombinedStore::of(old.clone())
    };
    let store: &dyn PlaceStore = &combined;
    assert_eq!(store.get(there.id).unwrap(), there);
    let Inserted::Created(written) = store.insert(reference(&city, 2)).unwrap() else {
        panic!("the store was empty");
    };
    assert_eq!(new.get(written.id).unwrap(), written);
    assert!(matches!(
        old.get(written.id),
        Err(StoreError::ReferenceNotFound { .. })
    ));
    assert_eq!(store.drain_damage().found, 1);
    assert_eq!(old.drain_damage().found, 0);
}
