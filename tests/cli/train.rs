//! `train`, `head train`, `head fit` and `map rehead` from flags to files, on a small drawn town.
#![cfg(feature = "lab")]

use crate::common::noise::values;
use crate::common::program::{SIZE, command, has_model, prints, refusal, succeeds, town, words};
use placeformer_core::progress::Silent;
use placeformer_core::types::GLOBAL_DIM;
use placeformer_models::open_extractor;
use placeformer_store::{ReadPlaces, SqliteStore, StoreConfig};
use placeformer_vision::extract::{
    Aggregate, Difference, ExtractConfig, Head, HeadChoice, NetVlad, NetVladParameters, Preset,
    VitWeights,
};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::path::Path;

/// `train` on the town for 20 steps, with further arguments.
fn train(more: &'static str) -> Vec<&'static str> {
    let mut arguments = words(
        "train --dataset csv --root town --cache cache --steps 20 --mine-every 5 --batch 4 \
         --input-size",
    );
    arguments.push(SIZE);
    arguments.extend(words(more));
    arguments
}

#[test]
fn a_head_is_trained_continued_and_given_to_a_map() {
    if !has_model() {
        return;
    }
    let folder = town("8", "2");
    let folder = folder.path();
    // The margin is wide so that every triplet teaches something.
    let command = train("--out run --learning-rate 0.01 --margin 0.5 --validation-share 0.3");
    let first = succeeds(folder, &command);
    assert!(
        first.contains("R@1") && first.contains("run/head.safetensors"),
        "{first}"
    );
    let log = std::fs::read_to_string(folder.join("run/train.jsonl")).unwrap();
    assert_eq!(log.lines().count(), 4, "{log}");
    let page = std::fs::read_to_string(folder.join("run/report.html")).unwrap();
    assert!(page.contains("Training loss") && page.contains("town"));
    // The same command finds the run finished; other data under the same folder is refused.
    let head = || Head::load(&folder.join("run/head.safetensors")).unwrap();
    let before = head();
    assert_eq!((succeeds(folder, &command), head()), (first, before));
    let other = train("--out run --learning-rate 0.01 --margin 0.5 --validation-share 0.6");
    assert!(refusal(folder, &other).contains("other data"));
    give_to_a_map(folder);
}

/// Imports with the built-in head, then exchanges it for the trained one: the map is what a server
/// with that head has.
fn give_to_a_map(folder: &Path) {
    // Validation may not have improved, in which case the head kept is the first; this one differs
    // for certain.
    let trained = Head::load(&folder.join("run/head.safetensors")).unwrap();
    let (weight, bias) = trained.weights();
    let scaled: Vec<f32> = weight
        .iter()
        .enumerate()
        .map(|(i, w)| if i % 2 == 0 { w * 1.5 } else { *w })
        .collect();
    let new = trained
        .with_weights(scaled.clone(), bias.to_vec(), trained.notes().clone())
        .unwrap();
    new.save(&folder.join("new.safetensors")).unwrap();
    succeeds(
        folder,
        &words("import town/database --map town --data store"),
    );
    let model = |name: &str| {
        let store = SqliteStore::open(&folder.join("store"), &StoreConfig::default()).unwrap();
        let mut globals = Vec::new();
        store
            .scan_globals(&name.parse().unwrap(), &mut |row| globals.push(row.global))
            .unwrap();
        (store.map(&name.parse().unwrap()).unwrap().model, globals)
    };
    let (before, old) = model("town");
    let gem = Head::new(
        Aggregate::gem(3.0).unwrap(),
        scaled,
        bias.to_vec(),
        new.backbone(),
        [].into(),
    )
    .unwrap();
    gem.save(&folder.join("gem.safetensors")).unwrap();
    let rehead = |head| ["map", "rehead", "town", "--head", head, "--data", "store"];
    let refused = refusal(folder, &rehead("gem.safetensors"));
    assert!(
        refused.contains("made by mean") && refused.contains("those of gem3"),
        "{refused}"
    );
    assert_eq!(
        model("town"),
        (before.clone(), old.clone()),
        "a refused head changes nothing"
    );
    assert!(succeeds(folder, &rehead("new.safetensors")).contains("16 references"));
    let (after, projected) = model("town");
    assert_eq!(after, new.rebind(&before).unwrap());
    assert!(succeeds(folder, &rehead("new.safetensors")).contains("already"));
    // What extraction with the new head gives, but for the half precision of what the store kept.
    let fresh = command(
        folder,
        &words("import town/database --map fresh --data store"),
    )
    .env("PLACEFORMER_EXTRACT__HEAD", "new.safetensors")
    .output()
    .unwrap();
    assert!(fresh.status.success());
    let (model_of_fresh, expected) = model("fresh");
    assert_eq!(model_of_fresh, after);
    // Four photos are imported at once, so the two maps differ in order.
    let nearest = |global: &Vec<f32>, others: &[Vec<f32>]| {
        let distance = |other: &Vec<f32>| {
            global
                .iter()
                .zip(other)
                .map(|(a, b)| (a - b) * (a - b))
                .sum::<f32>()
        };
        others.iter().map(distance).fold(f32::INFINITY, f32::min)
    };
    assert!(
        projected
            .iter()
            .all(|global| nearest(global, &expected) < 1e-4)
    );
    assert!(
        old.iter().all(|global| nearest(global, &expected) > 1e-4),
        "the new head is another"
    );
}

#[test]
fn the_last_block_is_trained_on_varied_images_of_drives() {
    if !has_model() {
        return;
    }
    let folder = town("8", "1");
    let mut arguments = words(
        "train --trainable last-1 --drives town/database town/queries --positive-frames 1 \
         --negative-frames 2 --validation-share 0.4 --steps 1 --mine-every 1 --warm-up 0 --batch 2 \
         --out blocks --input-size",
    );
    arguments.push(SIZE);
    let said = succeeds(folder.path(), &arguments);
    let weights = folder.path().join("blocks/weights.safetensors");
    let head = folder.path().join("blocks/head.safetensors");
    assert!(
        said.contains("blocks/weights.safetensors") && weights.exists(),
        "{said}"
    );
    // The head is bound to the weights that were written with it.
    let weights = VitWeights::load(&weights, Preset::Dinov2Vits14, None).unwrap();
    let bound = format!("dinov2-vits14:{}:b8", &weights.content_hash()[..12]);
    assert_eq!(Head::load(&head).unwrap().backbone(), bound);
}

/// A head of a NetVLAD with made-up values for the stock weights, in the file `start.safetensors`:
/// a fitted one would need more images than a test has.
fn made_up_netvlad(folder: &Path) {
    let extract = ExtractConfig {
        head: HeadChoice::None,
        ..ExtractConfig::default()
    };
    let backbone = open_extractor(&extract, &Silent)
        .unwrap()
        .backbone()
        .to_owned();
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut some = |count: usize| values(&mut random, count, 0.5);
    let parameters = NetVladParameters {
        mean: some(384),
        projection: some(8 * 384),
        words: some(4 * 8),
        assignment: some(4 * 8),
    };
    let aggregate = Aggregate::NetVlad(Box::new(NetVlad::new(parameters).unwrap()));
    let head = Head::new(
        aggregate,
        some(GLOBAL_DIM * 32),
        some(GLOBAL_DIM),
        backbone,
        [].into(),
    );
    head.unwrap()
        .save(&folder.join("start.safetensors"))
        .unwrap();
}

#[test]
fn the_recipe_for_streets_writes_a_difference_that_is_evaluated_and_imported_with() {
    if !has_model() {
        return;
    }
    let folder = town("8", "2");
    let folder = folder.path();
    made_up_netvlad(folder);
    for (out, more) in [("whole", ""), ("adapted", "--rank 2 --learning-rate 1e-3")] {
        let line = format!(
            "train --recipe streets --trainable last-1 --dataset csv --root town --steps 2 \
             --mine-every 1 --batch 4 --images-at-once 3 --cached-views 2 --token-cache tokens \
             --refit none --average 0.5 --keep last --validation-share 0.3 \
             --positive-metres 10 --negative-metres 25 \
             --head start.safetensors --out {out} {more} --input-size {SIZE}"
        );
        let (said, noted) = prints(folder, &words(&line));
        assert!(said.contains("difference.safetensors"), "{said}");
        assert!(
            noted.contains("GB are free"),
            "what the cache costs: {noted}"
        );
        let run = folder.join(out);
        let settings = std::fs::read_to_string(run.join("settings.json")).unwrap();
        for knob in [
            "info_nce",
            "temperature",
            "average",
            "hard_pairs",
            "10 m and 40 degrees",
        ] {
            assert!(settings.contains(knob), "{knob}: {settings}");
        }
        // The head is bound to the weights and to the difference that was written with it.
        let difference = Difference::load(&run.join("difference.safetensors")).unwrap();
        let bound = format!(
            "dinov2-vits14:{}:d{}:b8",
            &difference.base()[..12],
            &difference.content_hash()[..12]
        );
        assert_eq!(
            Head::load(&run.join("head.safetensors"))
                .unwrap()
                .backbone(),
            bound
        );
        let model = format!(
            "--difference {out}/difference.safetensors --head {out}/head.safetensors \
             --input-size {SIZE}"
        );
        let line = format!("eval --dataset csv --root town --no-rerank --cache eval {model}");
        let evaluated = succeeds(folder, &words(&line));
        assert!(evaluated.contains(&bound), "{evaluated}");
    }
    let size = |out: &str| {
        let path = folder.join(out).join("difference.safetensors");
        std::fs::metadata(path).unwrap().len()
    };
    assert!(size("whole") < 4_000_000, "{}", size("whole"));
    assert!(size("adapted") < 60_000, "{}", size("adapted"));
    // Without the difference the head is refused.
    let line = format!(
        "eval --dataset csv --root town --no-rerank --head whole/head.safetensors --input-size {SIZE}"
    );
    assert!(refusal(folder, &words(&line)).contains("was fitted for"));
}

/// Moves the places of the town apart, so that they lie in different blocks of ground.
fn spread_out(folder: &Path) {
    let path = folder.join("town/positions.csv");
    let text = std::fs::read_to_string(&path).unwrap();
    let mut lines = text.lines();
    let mut out = format!("{}\n", lines.next().unwrap());
    let mut first = None;
    for line in lines {
        let mut fields: Vec<String> = line.split(',').map(str::to_owned).collect();
        let point: [f64; 2] = [1, 2].map(|i| fields[i].parse().unwrap());
        let origin = *first.get_or_insert(point);
        for i in 0..2 {
            let apart = origin[i] + 100.0 * (point[i] - origin[i]);
            fields[1 + i] = apart.to_string();
        }
        out += &format!("{}\n", fields.join(","));
    }
    std::fs::write(path, out).unwrap();
}

#[test]
fn parts_of_the_ground_are_evaluated_apart() {
    if !has_model() {
        return;
    }
    let folder = town("8", "1");
    let folder = folder.path();
    spread_out(folder);
    let queries = |more: &str| -> u32 {
        let line = format!(
            "eval --dataset csv --root town --no-rerank --cache eval --input-size {SIZE} {more}"
        );
        let said = succeeds(folder, &words(&line));
        let part = more.strip_prefix("--hold-out ").unwrap_or_default();
        assert!(said.contains(part), "{said}");
        let (before, _) = said.split_once(" queries (").unwrap();
        before.rsplit(' ').next().unwrap().parse().unwrap()
    };
    let parts = ["train", "selection", "report"].map(|part| queries(&format!("--hold-out {part}")));
    assert!(parts.iter().all(|&count| count > 0), "{parts:?}");
    assert!(parts.iter().sum::<u32>() <= queries(""), "{parts:?}");
    let unknown = refusal(
        folder,
        &words("eval --dataset csv --root town --hold-out east"),
    );
    assert!(unknown.contains("selection"), "{unknown}");
}

#[test]
fn what_cannot_be_trained_is_refused_before_the_model_is_loaded() {
    let folder = town("8", "1");
    let folder = folder.path();
    std::fs::create_dir(folder.join("empty")).unwrap();
    for (arguments, part) in [
        ("train --out x", "--dataset"),
        ("train --out x --dataset csv", "--root"),
        (
            "train --out x --drives town/database --trainable last-0",
            "last-N",
        ),
        (
            "train --out x --drives town/database --viewpoint 0.1",
            "cached tokens",
        ),
        (
            "train --out x --drives town/database --warm-up 9000",
            "warm-up",
        ),
        ("train --out x --drives empty", "holds no JPEG"),
        (
            "train --out x --drives town/database --validation-share 2",
            "between 0 and 1",
        ),
        (
            "train --out x --drives town/database",
            "nothing to learn from",
        ),
        (
            "head train --out x --dataset csv --root town --positive-metres 30",
            "no order",
        ),
        (
            "train --out x --drives town/database --rank 4",
            "has no blocks",
        ),
        (
            "train --out x --drives town/database --recipe streets --viewpoint 0.1",
            "does not vary",
        ),
        (
            "train --out x --drives town/database --trainable last-10",
            "cannot be trained",
        ),
        ("head fit --images empty --out x", "no images"),
        (
            "head fit --images town --out x --aggregate gem --gem-p 0.5",
            "from 1 to 64",
        ),
        ("map rehead town --head absent --data town", "absent"),
    ] {
        let error = refusal(folder, &words(arguments));
        assert!(error.contains(part), "{arguments}: {error}");
    }
}
