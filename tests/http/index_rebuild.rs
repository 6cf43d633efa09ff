//! The index is a cache of the store: after any history, a service rebuilt from the store answers
//! as the live one does, and both as a plain model of what was asked of them says.

use crate::common::places::{map, named_reference, reference, unit_vector};
use crate::support::{self, FakeSource, picture};
use bytes::Bytes;
use placeformer::config::Config;
use placeformer::pipeline::{Caller, IngestRequest, QueryOptions, QueryRequest, Service};
use placeformer_core::error::ErrorCode;
use placeformer_core::types::{
    ContentHash, GLOBAL_DIM, GeoCircle, GeoPoint, MapName, NewReference, Reference,
    ReferenceFields, ReferenceFilter, ReferenceId, Timestamp,
};
use placeformer_store::{
    Inserted, ReadPlaces, ReferencePatch, SqliteStore, StoreConfig, WritePlaces,
};
use placeformer_vision::search::{IndexBuilder, IndexEntry, MapIndex};
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

// ---------------------------------------------------------------- any history

const MAPS: u8 = 3;

#[derive(Debug, Clone)]
enum Operation {
    /// A photo for a map; by name it may be there already, as the same or as another photo.
    Ingest {
        map: u8,
        photo: u64,
        name: Option<u8>,
        place: Option<u8>,
        minute: Option<u8>,
    },
    /// Another place or time for a reference; the inner `None` clears it.
    Patch {
        which: prop::sample::Index,
        place: Option<Option<u8>>,
        minute: Option<Option<u8>>,
    },
    Delete(prop::sample::Index),
    DeleteMap(u8),
    Restart,
}

fn operation() -> impl Strategy<Value = Operation> {
    let small = || prop::option::of(0u8..10);
    prop_oneof![
        12 => (0..MAPS, 0u64..6, prop::option::of(0u8..4), small(), small())
            .prop_map(|(map, photo, name, place, minute)| Operation::Ingest {
                map,
                photo,
                name,
                place,
                minute,
            }),
        5 => (any::<prop::sample::Index>(), prop::option::of(small()), prop::option::of(small()))
            .prop_map(|(which, place, minute)| Operation::Patch { which, place, minute }),
        4 => any::<prop::sample::Index>().prop_map(Operation::Delete),
        1 => (0..MAPS).prop_map(Operation::DeleteMap),
        1 => Just(Operation::Restart),
    ]
}

fn name_of(map: u8) -> MapName {
    format!("map-{map}").parse().unwrap()
}

/// Places lie 111 metres apart.
fn place(place: u8) -> GeoPoint {
    GeoPoint::new(51.0 + f64::from(place) * 1e-3, 7.0).unwrap()
}

fn minute(minute: u8) -> Timestamp {
    Timestamp::from_unix_micros((1_700_000_000 + 60 * i64::from(minute)) * 1_000_000).unwrap()
}

fn start(directory: &Path) -> Arc<Service> {
    let store = StoreConfig {
        reserve_bytes: 1 << 20,
        ..Default::default()
    };
    support::open(
        directory,
        FakeSource::new("fake-1"),
        Config {
            store,
            ..Default::default()
        },
    )
    .1
}

/// What there must be, in the order of identities.
#[derive(Default)]
struct Model(BTreeMap<ReferenceId, Reference>);

impl Model {
    fn pick(&self, which: prop::sample::Index) -> Option<ReferenceId> {
        (!self.0.is_empty()).then(|| *self.0.keys().nth(which.index(self.0.len())).unwrap())
    }

    fn of(&self, map: &MapName) -> Vec<Reference> {
        self.0
            .values()
            .filter(|reference| reference.map == *map)
            .cloned()
            .collect()
    }
}

struct History {
    directory: tempfile::TempDir,
    runtime: tokio::runtime::Runtime,
    service: Option<Arc<Service>>,
    model: Model,
    gone: Vec<ReferenceId>,
    /// Maps that exist: one that lost its last reference still does.
    maps: std::collections::BTreeSet<MapName>,
}

impl History {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let service = Some(start(directory.path()));
        let runtime = tokio::runtime::Runtime::new().unwrap();
        Self {
            directory,
            runtime,
            service,
            model: Model::default(),
            gone: Vec::new(),
            maps: Default::default(),
        }
    }

    fn restart(&mut self) {
        // The store must be closed before it can be opened again.
        let closed = self.service.take().and_then(Arc::into_inner);
        drop(closed.expect("nobody else holds the service"));
        self.service = Some(start(self.directory.path()));
    }

    fn service(&self) -> &Arc<Service> {
        self.service
            .as_ref()
            .expect("it is taken only to be replaced")
    }

    fn run(&mut self, operation: Operation) {
        match operation {
            Operation::Ingest {
                map,
                photo,
                name,
                place: at,
                minute: when,
            } => {
                let fields = ReferenceFields {
                    external_id: name.map(|name| format!("photo {name}").parse().unwrap()),
                    location: at.map(place),
                    captured_at: when.map(minute),
                    ..Default::default()
                };
                self.ingest(name_of(map), photo, fields);
            }
            Operation::Patch {
                which,
                place: at,
                minute: when,
            } => {
                let Some(id) = self.model.pick(which) else {
                    return;
                };
                let patch = ReferencePatch {
                    location: at.map(|at| at.map(place)),
                    captured_at: when.map(|when| when.map(minute)),
                    ..Default::default()
                };
                let changed = self
                    .runtime
                    .block_on(self.service().update(&Caller::Local, id, patch.clone()))
                    .unwrap();
                let expected = self.model.0.get_mut(&id).unwrap();
                patch.apply(&mut expected.fields);
                assert_eq!(changed, *expected);
            }
            Operation::Delete(which) => {
                let Some(id) = self.model.pick(which) else {
                    return;
                };
                let deleting = self.service().delete(&Caller::Local, id);
                let deleted = self.runtime.block_on(deleting).unwrap();
                assert_eq!(Some(deleted), self.model.0.remove(&id));
                self.gone.push(id);
            }
            Operation::DeleteMap(map) => {
                let name = name_of(map);
                let deleted = self
                    .runtime
                    .block_on(self.service().delete_map(&Caller::Local, name.clone()));
                match self.maps.remove(&name) {
                    true => assert_eq!(deleted.unwrap(), self.model.of(&name).len() as u64),
                    false => assert_eq!(deleted.unwrap_err().code(), ErrorCode::MapNotFound),
                }
                self.gone
                    .extend(self.model.of(&name).iter().map(|reference| reference.id));
                self.model.0.retain(|_, reference| reference.map != name);
            }
            Operation::Restart => self.restart(),
        }
    }

    fn ingest(&mut self, map: MapName, photo: u64, fields: ReferenceFields) {
        let image = Bytes::from(picture(photo));
        let content = ContentHash::of(&image);
        let named = |reference: &&Reference| {
            reference.fields.external_id.is_some()
                && reference.fields.external_id == fields.external_id
        };
        let holder = self.model.of(&map).iter().find(named).cloned();
        let request = IngestRequest {
            map: map.clone(),
            fields: fields.clone(),
            image,
            reads_photo: true,
            allow_uninformative: false,
        };
        let answer = self
            .runtime
            .block_on(self.service().ingest(&Caller::Local, request));
        match holder {
            Some(holder) if holder.content_hash == content => {
                let answer = answer.unwrap();
                assert_eq!((answer.created, answer.reference), (false, holder));
            }
            Some(_) => assert_eq!(answer.unwrap_err().code(), ErrorCode::ExternalIdConflict),
            None => {
                let answer = answer.unwrap();
                assert!(answer.created);
                assert_eq!(
                    (&answer.reference.fields, answer.reference.content_hash),
                    (&fields, content)
                );
                assert_eq!(answer.reference.map, map);
                self.maps.insert(map);
                self.model.0.insert(answer.reference.id, answer.reference);
            }
        }
    }

    /// Everything that can be read of the service equals the model; what a search finds is
    /// returned.
    fn check(&self) -> Vec<Vec<(ReferenceId, f32)>> {
        let service = self.service();
        self.runtime.block_on(async {
            for (id, expected) in &self.model.0 {
                assert_eq!(
                    service.reference(&Caller::Local, *id).await.unwrap(),
                    *expected
                );
            }
            for id in &self.gone {
                assert_eq!(
                    service
                        .reference(&Caller::Local, *id)
                        .await
                        .unwrap_err()
                        .code(),
                    ErrorCode::ReferenceNotFound
                );
            }
            let maps = service.maps(&Caller::Local).await.unwrap();
            assert_eq!(
                maps.iter().map(|map| &map.name).collect::<Vec<_>>(),
                self.maps.iter().collect::<Vec<_>>()
            );
            assert_eq!(
                listed(service, None).await,
                self.model.0.values().cloned().collect::<Vec<_>>()
            );
            let mut found = Vec::new();
            for map in maps {
                let expected = self.model.of(&map.name);
                assert_eq!(map.references, expected.len() as u64);
                assert_eq!(listed(service, Some(map.name.clone())).await, expected);
                for filter in filters() {
                    found.push(self.search(&map.name, filter).await);
                }
            }
            found
        })
    }

    /// All references of a map that pass the filter, nearest first; which ones, the model says.
    async fn search(&self, map: &MapName, filter: ReferenceFilter) -> Vec<(ReferenceId, f32)> {
        let options = QueryOptions {
            top_k: Some(1000),
            rerank: Some(false),
            filter,
            ..Default::default()
        };
        let request = QueryRequest {
            map: map.clone(),
            image: Bytes::from(picture(2)),
            options,
        };
        let answer = self.service().query(&Caller::Local, request).await.unwrap();
        let passes = |fields: &ReferenceFields| filter.accepts(fields.location, fields.captured_at);
        let expected = self
            .model
            .of(map)
            .into_iter()
            .filter(|reference| passes(&reference.fields));
        let mut references: Vec<Reference> = answer
            .results
            .iter()
            .map(|result| result.reference.clone())
            .collect();
        references.sort_by_key(|reference| reference.id);
        assert_eq!(references, expected.collect::<Vec<_>>(), "{filter:?}");
        answer
            .results
            .iter()
            .map(|result| (result.reference.id, result.global_distance))
            .collect()
    }
}

/// A listing, three at a time.
async fn listed(service: &Arc<Service>, map: Option<MapName>) -> Vec<Reference> {
    let mut all = Vec::new();
    let mut after = None;
    loop {
        let page = service
            .references(&Caller::Local, map.clone(), after, 3)
            .await
            .unwrap();
        assert!(page.references.len() == 3 || page.next.is_none());
        all.extend(page.references);
        after = page.next;
        if after.is_none() {
            return all;
        }
    }
}

fn filters() -> [ReferenceFilter; 3] {
    let near = GeoCircle::new(place(3), 250.0).unwrap();
    [
        ReferenceFilter::default(),
        ReferenceFilter {
            near: Some(near),
            ..Default::default()
        },
        ReferenceFilter {
            captured_after: Some(minute(5)),
            ..Default::default()
        },
    ]
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 16,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]
    #[test]
    fn rebuilt_equals_live_after_any_history(
        operations in prop::collection::vec(operation(), 0..40),
    ) {
        let mut history = History::new();
        operations.into_iter().for_each(|operation| history.run(operation));
        let live = history.check();
        history.restart();
        prop_assert_eq!(history.check(), live);
    }
}

// ---------------------------------------------------------------- many blocks

fn open(directory: &std::path::Path) -> SqliteStore {
    SqliteStore::open(
        directory,
        &StoreConfig {
            reserve_bytes: 1 << 20,
            ..StoreConfig::default()
        },
    )
    .unwrap()
}

fn rebuild(store: &SqliteStore, map: &MapName) -> MapIndex {
    let mut entries = IndexBuilder::default();
    if store.map(map).is_ok() {
        store
            .scan_globals(map, &mut |row| {
                let (id, global) = (row.reference, row.global);
                entries.push(IndexEntry {
                    id,
                    global,
                    location: row.location,
                    alt: row.alt,
                    heading: row.heading,
                    captured_at: row.captured_at,
                });
            })
            .unwrap();
    }
    entries.finish()
}

fn entry(reference: &Reference, new: &NewReference) -> IndexEntry {
    IndexEntry {
        id: reference.id,
        global: new.descriptor.global.clone(),
        location: reference.fields.location,
        alt: reference.fields.alt,
        heading: reference.fields.heading,
        captured_at: reference.fields.captured_at,
    }
}

fn assert_equal(a: &MapIndex, b: &MapIndex) {
    assert_eq!(a.len(), b.len());
    let filters = [
        ReferenceFilter::default(),
        ReferenceFilter {
            captured_after: Some(Timestamp::from_unix_micros(1_700_000_100_000_000).unwrap()),
            ..ReferenceFilter::default()
        },
    ];
    for (seed, filter) in (0..3).flat_map(|seed| filters.iter().map(move |filter| (seed, filter))) {
        let query = unit_vector(seed, GLOBAL_DIM);
        assert_eq!(
            a.search(&query, a.len() + 1, filter),
            b.search(&query, a.len() + 1, filter)
        );
    }
}

#[test]
fn rebuilt_equals_live_across_many_blocks() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path());
    let city = map("city");
    let live = MapIndex::default();
    let made = |seed: u64| match seed % 2 {
        0 => reference(&city, seed),
        _ => named_reference(&city, &format!("photo {seed}"), seed),
    };
    let new: Vec<NewReference> = (0..9000).map(made).collect();
    let mut ids = Vec::new();
    for (outcome, new) in store.insert_many(new.clone()).into_iter().zip(&new) {
        let Ok(Inserted::Created(created)) = outcome else {
            panic!("{outcome:?}")
        };
        live.insert(entry(&created, new));
        ids.push(created.id);
    }
    assert_equal(&rebuild(&store, &city), &live);
    // Several threads, so that their deletions share syncs of the disk.
    let doomed: Vec<ReferenceId> = ids.into_iter().filter(|id| id.seed() % 3 != 0).collect();
    std::thread::scope(|scope| {
        for part in doomed.chunks(doomed.len().div_ceil(32)) {
            let (store, live) = (&store, &live);
            scope.spawn(move || {
                for id in part {
                    store.delete(*id).unwrap();
                    assert!(live.remove(*id));
                }
            });
        }
    });
    assert_equal(&rebuild(&store, &city), &live);
}
