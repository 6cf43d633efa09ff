//! The cache on made-up images: what is read again, what is computed anew, what is listed.

use super::*;
use placeformer_core::progress::Silent;
use placeformer_core::types::{
    Descriptor, ImageSize, KeyPatches, ModelId, PatchGrid, PoolingStride,
};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Describes an image by its first byte; refuses those that start with `!`.
struct FirstByte {
    model: ModelId,
    kernels: &'static [u8],
    described: AtomicUsize,
}

impl FirstByte {
    fn new(model: &str) -> Self {
        Self {
            model: ModelId::new(model),
            kernels: b"first",
            described: AtomicUsize::new(0),
        }
    }
}

impl Describe for FirstByte {
    fn model(&self) -> &ModelId {
        &self.model
    }

    fn computed_by(&self) -> String {
        "test".into()
    }

    fn fingerprint(&self) -> Result<ContentHash, EvalError> {
        Ok(ContentHash::of(self.kernels))
    }

    fn tensor(&self, bytes: &[u8]) -> Result<ImageTensor, String> {
        match bytes.first() {
            None => Err("the image is empty".into()),
            Some(b'!') => Err("not an image".into()),
            Some(&byte) => Ok(ImageTensor {
                size: ImageSize {
                    width: 1,
                    height: 1,
                },
                data: vec![f32::from(byte)],
            }),
        }
    }

    fn describe(&self, images: &[ImageTensor]) -> Result<Vec<Descriptor>, EvalError> {
        self.described.fetch_add(images.len(), Ordering::Relaxed);
        let grid = PatchGrid {
            columns: 4,
            rows: 3,
            patch_px: 14,
            stride: PoolingStride::Kernel,
        };
        let descriptor = |image: &ImageTensor| {
            let value = image.data[0];
            let patches = PackedPatches {
                grid,
                dim: 2,
                counts: [1, 0, 0],
                index: vec![5],
                attention: vec![half::f16::ONE],
                factor: vec![value],
                codes: vec![1, -1],
            };
            Descriptor {
                global: vec![value, 1.0],
                pooled: vec![value; 3],
                patches,
            }
        };
        Ok(images.iter().map(descriptor).collect())
    }

    fn key_patches(&self, _: &ImageTensor) -> Result<KeyPatches, EvalError> {
        Err(EvalError::Setting(
            "nothing here asks for full precision".into(),
        ))
    }
}

fn items(folder: &Path, contents: &[(&str, &[u8])]) -> Vec<Item> {
    let item = |(name, content): &(&str, &[u8])| {
        let path = folder.join(name);
        std::fs::write(&path, content).unwrap();
        Item::new(*name, path)
    };
    contents.iter().map(item).collect()
}

fn run(
    describer: &FirstByte,
    root: &Path,
    items: &[Item],
    kind: GlobalKind,
) -> (FeatureCache, Features) {
    let cache = FeatureCache::open(root, describer, 1 << 20).unwrap();
    let features = cache
        .describe_all(
            describer,
            items,
            "database",
            kind,
            &Task::begin(&Silent, "describing", items.len() as u64),
        )
        .unwrap();
    (cache, features)
}

const CONTENTS: [(&str, &[u8]); 5] = [
    ("bad.jpg", b"!x"),
    ("a.jpg", b"a"),
    ("empty.jpg", b""),
    ("b.jpg", b"b"),
    ("copy_of_a.jpg", b"a"),
];

#[test]
fn unreadable_images_are_listed_and_the_others_keep_their_places() {
    let folder = tempfile::tempdir().unwrap();
    let mut items = items(folder.path(), &CONTENTS);
    items.push(Item::new("gone.jpg", folder.path().join("gone.jpg")));
    let (cache, features) = run(
        &FirstByte::new("m"),
        folder.path(),
        &items,
        GlobalKind::Head,
    );
    assert_eq!(
        features.globals,
        [
            0.0, 0.0, 97.0, 1.0, 0.0, 0.0, 98.0, 1.0, 97.0, 1.0, 0.0, 0.0
        ]
    );
    assert_eq!(
        (features.global(1), features.global(2)),
        (Some(&[97.0, 1.0][..]), None)
    );
    let names: Vec<_> = features
        .unreadable
        .iter()
        .map(|u| u.name.as_str())
        .collect();
    assert_eq!(names, ["bad.jpg", "empty.jpg", "gone.jpg"]);
    assert_eq!(features.unreadable[0].reason, "not an image");
    assert_eq!(cache.patches(&features, 3).unwrap().factor, [98.0]);
    assert!(cache.patches(&features, 0).is_err());
}

#[test]
fn a_second_run_computes_nothing_and_a_changed_image_only_itself() {
    let folder = tempfile::tempdir().unwrap();
    let all = items(folder.path(), &CONTENTS);
    run(&FirstByte::new("m"), folder.path(), &all, GlobalKind::Head);
    let again = FirstByte::new("m");
    let second = run(&again, folder.path(), &all, GlobalKind::Mean).1;
    assert_eq!(
        (second.fresh, again.described.load(Ordering::Relaxed)),
        (0, 0)
    );
    assert_eq!((second.dim, second.pooled_dim), (3, 3));
    std::fs::write(folder.path().join("b.jpg"), b"c").unwrap();
    assert_eq!(
        run(&FirstByte::new("m"), folder.path(), &all, GlobalKind::Head)
            .1
            .fresh,
        1
    );
    // Another model shares nothing, nor do kernels that round otherwise.
    assert_eq!(
        run(
            &FirstByte::new("n"),
            folder.path(),
            &all[1..2],
            GlobalKind::Head
        )
        .1
        .fresh,
        1
    );
    let rebuilt = FirstByte {
        kernels: b"second",
        ..FirstByte::new("m")
    };
    assert_eq!(
        run(&rebuilt, folder.path(), &all[1..2], GlobalKind::Head)
            .1
            .fresh,
        1
    );
}

#[test]
fn cut_or_changed_records_are_computed_anew() {
    let folder = tempfile::tempdir().unwrap();
    let all = items(folder.path(), &[("a.jpg", b"a")]);
    let (cache, features) = run(&FirstByte::new("m"), folder.path(), &all, GlobalKind::Head);
    let path = cache.path(&features.records[0].unwrap());
    let whole = std::fs::read(&path).unwrap();
    let mut flipped = whole.clone();
    flipped[40] ^= 1;
    for damaged in [&whole[..whole.len() - 1], &whole[..3], &[][..], &flipped] {
        std::fs::write(&path, damaged).unwrap();
        let (cache, again) = run(&FirstByte::new("m"), folder.path(), &all, GlobalKind::Head);
        assert_eq!(
            (again.fresh, again.globals.as_slice()),
            (1, &[97.0, 1.0][..])
        );
        assert!(cache.patches(&again, 0).is_ok());
    }
}

#[test]
fn a_record_survives_its_encoding() {
    let tensor = FirstByte::new("m").tensor(b"z").unwrap();
    let descriptor = FirstByte::new("m").describe(&[tensor]).unwrap().remove(0);
    let seconds = ExtractionSeconds {
        decode: 0.25,
        extract: 1.5,
    };
    let mut record = Record {
        seconds,
        blob_bytes: 0,
        descriptor,
    };
    let bytes = record.encode().unwrap();
    assert_eq!(Record::decode(&bytes), Some(record));
}
