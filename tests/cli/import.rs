//! `import` as a command: a folder of photos and everything else that lies in folders, into a
//! served map and into a store.

use crate::common::noise;
use crate::common::photo::{Says, png_with_exif, with_chunk};
use crate::common::program::{has_model, offline, placeformer, words};
use crate::common::service::App;
use placeformer_core::types::ImageSize;
use placeformer_vision::image::{RgbImage, encode_png};
use serde_json::{Value, json};
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};
use std::os::unix::net::UnixListener;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use tokio::runtime::Runtime;

/// A server, and a folder with an empty folder `photos`.
struct Served {
    runtime: Runtime,
    app: App,
    url: String,
    folder: TempDir,
}

/// What an import printed, and its report.
#[derive(Debug)]
struct Imported {
    success: bool,
    said: String,
    errors: String,
    lines: Vec<Value>,
}

impl Imported {
    /// The line of the report about `file`.
    #[track_caller]
    fn line(&self, file: &str) -> &Value {
        let mut lines = self.lines.iter();
        let found = lines.find(|line| line["file"] == file);
        found.unwrap_or_else(|| panic!("no line for {file:?}: {self:#?}"))
    }

    #[track_caller]
    fn verdict(&self, file: &str) -> (&str, &str) {
        let line = self.line(file);
        let text = |key: &str| line[key].as_str().unwrap_or_default();
        (text("status"), text("code"))
    }

    #[track_caller]
    fn succeeded(self) -> Self {
        assert!(self.success, "{self:#?}");
        self
    }

    #[track_caller]
    fn failed(self) -> Self {
        assert!(!self.success, "{self:#?}");
        self
    }
}

impl Served {
    fn new() -> Self {
        let runtime = Runtime::new().unwrap();
        let app = App::new();
        let url = app.listen(&runtime);
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("photos")).unwrap();
        Self {
            runtime,
            app,
            url,
            folder,
        }
    }

    fn photos(&self) -> PathBuf {
        self.folder.path().join("photos")
    }

    /// Writes a photo of its own into the folder `photos`.
    fn photo(&self, name: &str) {
        self.write(name, &picture(name));
    }

    fn write(&self, name: impl AsRef<Path>, bytes: &[u8]) {
        let path = self.photos().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }

    fn import(&self, more: &[&str]) -> Imported {
        self.import_from("photos", more)
    }

    fn import_from(&self, from: &str, more: &[&str]) -> Imported {
        let fixed = words("import --map m --report report.jsonl --attempts 1 --server");
        let arguments = [&fixed[..], &[&self.url, from], more].concat();
        imported(
            self.folder.path(),
            &mut offline(self.folder.path(), &arguments),
        )
    }

    /// Location and time that the map has of a photo.
    #[track_caller]
    fn stored(&self, external_id: &str) -> (Value, Value) {
        let found = self.references();
        let mut found = found.iter();
        let found = found.find(|reference| reference["external_id"] == external_id);
        let found = found.unwrap_or_else(|| panic!("no reference {external_id:?}"));
        (found["location"].clone(), found["captured_at"].clone())
    }

    fn references(&self) -> Vec<Value> {
        let page = self.app.get("/references?map=m&limit=1000");
        let page = self.runtime.block_on(page);
        page.ok()["references"].as_array().unwrap().clone()
    }
}

fn imported(folder: &Path, command: &mut std::process::Command) -> Imported {
    let output = command.output().expect("the binary was built");
    let report = std::fs::read_to_string(folder.join("report.jsonl")).unwrap_or_default();
    let lines = report
        .lines()
        .map(|line| serde_json::from_str(line).unwrap());
    Imported {
        success: output.status.success(),
        said: String::from_utf8(output.stdout).unwrap(),
        errors: String::from_utf8(output.stderr).unwrap(),
        lines: lines.collect(),
    }
}

fn picture(name: &str) -> Vec<u8> {
    noise::png(u64::from(crc32fast::hash(name.as_bytes())), 64, 48)
}

fn at(lat: f64, lon: f64) -> Value {
    json!({"lat": lat, "lon": lon, "alt": null, "heading": null})
}

#[test]
fn what_is_no_photo_gets_a_verdict_and_the_others_are_imported() {
    let served = Served::new();
    for name in ["a.png", "b.jfif", "c.JPE", "sub/d.webp"] {
        served.photo(name);
    }
    for name in [
        "x.heic",
        "y.HEIC",
        "clip.mp4",
        "._a.png",
        ".DS_Store",
        "Thumbs.db",
        "notes",
    ] {
        served.write(name, b"x");
    }
    served.photo("@eaDir/a.png/SYNOPHOTO_THUMB_M.png");
    served.photo("lost+found/#12.png");
    let path = |name: &str| served.photos().join(name);
    symlink("nowhere", path("dangling.jpg")).unwrap();
    symlink("loop.jpg", path("loop.jpg")).unwrap();
    symlink("..", path("sub/up")).unwrap();
    symlink("/", path("root")).unwrap();
    symlink("a.png", path("link.png")).unwrap();
    symlink("/dev/zero", path("zero.jpg")).unwrap();
    let _socket = UnixListener::bind(path("socket.jpg")).unwrap();
    let mode = rustix::fs::Mode::from_raw_mode(0o644);
    let fifo = rustix::fs::FileType::Fifo;
    rustix::fs::mknodat(rustix::fs::CWD, path("pipe.jpg"), fifo, mode, 0).unwrap();

    let imported = served.import(&[]).failed();
    assert_eq!(served.references().len(), 5);
    for name in ["a.png", "b.jfif", "c.JPE", "sub/d.webp", "link.png"] {
        assert_eq!(imported.verdict(name), ("created", ""), "{name}");
    }
    for (name, code) in [
        ("dangling.jpg", "broken_link"),
        ("loop.jpg", "broken_link"),
        ("zero.jpg", "special_file"),
        ("socket.jpg", "special_file"),
        ("pipe.jpg", "special_file"),
    ] {
        assert_eq!(imported.verdict(name), ("failed", code), "{name}");
        assert!(
            imported.errors.contains(&format!("{name}: ")),
            "{imported:#?}"
        );
    }
    for (name, code) in [
        ("x.heic", "unsupported_file"),
        ("clip.mp4", "unsupported_file"),
        ("notes", "unsupported_file"),
        ("._a.png", "resource_fork"),
        (".DS_Store", "hidden"),
        ("Thumbs.db", "system_entry"),
        ("@eaDir", "system_entry"),
        ("lost+found", "system_entry"),
        ("sub/up", "linked_folder"),
        ("root", "linked_folder"),
    ] {
        assert_eq!(imported.verdict(name), ("ignored", code), "{name}");
    }
    assert_eq!(imported.lines.len(), 5 + 5 + 11);
    let said = &imported.said;
    assert!(
        said.contains("5 created, 0 already there, 5 failed, 11 ignored"),
        "{said}"
    );
    assert!(said.contains("2 heic") && said.contains("1 mp4"), "{said}");
    assert!(imported.errors.contains("5 of 10 photos"), "{imported:#?}");

    for name in [
        "dangling.jpg",
        "loop.jpg",
        "zero.jpg",
        "socket.jpg",
        "pipe.jpg",
    ] {
        std::fs::remove_file(path(name)).unwrap();
    }
    let again = served.import(&[]).succeeded();
    assert!(
        again.said.contains("0 created, 5 already there, 0 failed"),
        "{again:#?}"
    );
}

#[test]
fn a_folder_that_cannot_be_read_gets_a_verdict_and_the_others_are_imported() {
    let served = Served::new();
    served.photo("a.png");
    served.photo("closed/b.png");
    let closed = served.photos().join("closed");
    let permit = |path: &Path, mode: u32| {
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).unwrap();
    };
    permit(&closed, 0o000);
    let fixed = ["import", "photos", "--map", "m", "--server", &served.url];
    let mut command = offline(served.folder.path(), &fixed);
    command.args(["--report", "report.jsonl"]);
    if served.folder.path().metadata().unwrap().uid() == 0 {
        // Permissions do not bind root, so another user runs the program, from a folder of theirs.
        const NOBODY: u32 = 65_534;
        std::os::unix::fs::chown(served.folder.path(), Some(NOBODY), None).unwrap();
        permit(&served.photos(), 0o755);
        let binary = served.folder.path().join("placeformer");
        std::fs::hard_link(env!("CARGO_BIN_EXE_placeformer"), &binary)
            .or_else(|_| std::fs::copy(env!("CARGO_BIN_EXE_placeformer"), &binary).map(|_| ()))
            .unwrap();
        let mut as_nobody = std::process::Command::new(binary);
        as_nobody.args(command.get_args()).uid(NOBODY);
        command = as_nobody;
        command.current_dir(served.folder.path());
    }
    let imported = imported(served.folder.path(), &mut command).failed();
    permit(&closed, 0o755);
    assert_eq!(imported.verdict("a.png"), ("created", ""));
    assert_eq!(imported.verdict("closed"), ("failed", "unreadable"));
    assert!(imported.said.contains("1 created"), "{imported:#?}");
}

#[test]
fn names_are_kept_apart_and_shown_without_effect() {
    let served = Served::new();
    let broken: [&[u8]; 2] = [b"caf\xe9.png", b"caf\xea.png"];
    for name in broken {
        served.write(OsStr::from_bytes(name), &picture(&format!("{name:?}")));
    }
    served.photo("new\nline.png");
    served.photo("caf\u{e9}.png");
    let hostile = "\u{1b}[31mred\u{202e}gpj.png";
    served.write(hostile, b"no image");
    symlink(
        "nowhere",
        served.photos().join("\u{1b}]0;title\u{7}\u{2066}.jpg"),
    )
    .unwrap();
    let imported = served.import(&[]).failed();
    for name in [
        "caf\\xe9.png",
        "caf\\xea.png",
        "caf\u{e9}.png",
        "new\\x0aline.png",
    ] {
        assert_eq!(imported.verdict(name), ("created", ""), "{name}");
        served.stored(name);
    }
    let shown = [imported.said.as_str(), &imported.errors].concat();
    let is_harmful = |c: char| c != '\n' && (c.is_control() || "\u{202e}\u{2066}".contains(c));
    assert!(!shown.contains(is_harmful), "{shown:?}");
    assert!(shown.contains("\\u{202e}gpj.png"), "{shown}");
    // Folders and tables have names, too.
    let missing = served.import_from("no\u{1b}where\n", &[]).failed();
    assert!(!missing.errors.contains('\u{1b}'), "{missing:?}");
    let table = served
        .import(&["--positions", "no\u{1b}where.csv"])
        .failed();
    assert!(!table.errors.contains('\u{1b}'), "{table:?}");
}

#[test]
fn one_photo_is_imported_and_a_folder_without_any_says_what_it_holds() {
    let served = Served::new();
    served.write("clip.mov", b"x");
    let nothing = served.import(&[]).failed();
    assert!(nothing.errors.contains("holds no JPEG"), "{nothing:#?}");
    assert!(nothing.errors.contains("1 mov"), "{nothing:#?}");
    assert_eq!(nothing.verdict("clip.mov"), ("ignored", "unsupported_file"));
    served.photo("one.png");
    std::fs::write(
        served.folder.path().join("p.csv"),
        "file,lat,lon\none.png,1,2\n",
    )
    .unwrap();
    let from = ["--positions", "p.csv"];
    served.import_from("photos/one.png", &from).succeeded();
    assert_eq!(served.stored("one.png").0, at(1.0, 2.0));
}

#[test]
fn photos_that_show_nothing_are_reported_and_imported_on_demand() {
    let served = Served::new();
    served.photo("street.png");
    let size = ImageSize {
        width: 64,
        height: 48,
    };
    let dark = encode_png(&RgbImage::filled(size, [3, 2, 2])).unwrap();
    served.write("dark.png", &dark);
    let imported = served.import(&[]).failed();
    assert_eq!(
        imported.verdict("dark.png"),
        ("failed", "image_uninformative")
    );
    assert_eq!(imported.verdict("street.png").0, "created");
    let imported = served.import(&["--allow-uninformative"]).succeeded();
    assert_eq!(imported.verdict("dark.png").0, "created");
}

#[test]
fn positions_arrive_at_photos_that_are_there_and_are_told() {
    let served = Served::new();
    let says = Says {
        position: Some((10.0, 20.0)),
        alt: None,
        heading: None,
        time: Some("2026:03:01 14:30:05"),
    };
    for seed in 0..2 {
        served.write(format!("{seed}.png"), &png_with_exif(seed, says));
    }
    served.photo("bare.png");
    served.import(&["--no-exif"]).succeeded();
    assert_eq!(served.stored("0.png"), (Value::Null, Value::Null));
    // What the photos say fills the gaps.
    let filled = served.import(&[]).succeeded();
    assert!(
        filled
            .said
            .contains("0 created, 2 updated, 1 already there"),
        "{filled:#?}"
    );
    let utc = json!("2026-03-01T14:30:05Z");
    assert_eq!(served.stored("0.png"), (at(10.0, 20.0), utc));
    assert_eq!(
        filled.line("0.png")["changed"],
        json!(["location", "captured_at"])
    );

    let table = served.folder.path().join("positions.csv");
    std::fs::write(
        &table,
        "\u{feff}File;Latitude;LNG\r\n0.png;48,85;2,29\r\nbare.png;1;2\r\n",
    )
    .unwrap();
    let from = ["--positions", "positions.csv"];
    let updated = served.import(&from).succeeded();
    assert!(
        updated
            .said
            .contains("0 created, 2 updated, 1 already there"),
        "{updated:#?}"
    );
    assert_eq!(updated.verdict("0.png"), ("updated", ""));
    assert_eq!(updated.verdict("1.png"), ("skipped", ""));
    assert_eq!(served.stored("0.png").0, at(48.85, 2.29));
    assert_eq!(served.stored("bare.png").0, at(1.0, 2.0));
    // Without the table nothing falls back, and with it nothing is left to do.
    for arguments in [&[][..], &from] {
        let again = served.import(arguments).succeeded();
        assert!(
            again.said.contains("0 created, 3 already there"),
            "{again:#?}"
        );
    }
    assert_eq!(served.stored("0.png").0, at(48.85, 2.29));

    let zoned = served.import(&["--timezone", "Europe/Paris"]).succeeded();
    assert!(zoned.said.contains("2 updated"), "{zoned:#?}");
    assert_eq!(served.stored("1.png").1, json!("2026-03-01T13:30:05Z"));
    let nowhere = served.import(&["--timezone", "Europe/Nowhere"]).failed();
    assert!(nowhere.errors.contains("Europe/Paris"), "{nowhere:#?}");
}

#[test]
fn rows_that_match_nothing_fail_the_import_unless_they_may() {
    let served = Served::new();
    served.photo("a.png");
    let table = served.folder.path().join("positions.csv");
    std::fs::write(&table, "file,lat,lon\n./a.png,1,2\nb\u{1b}.png,3,4\n").unwrap();
    let from = ["--positions", "positions.csv"];
    let imported = served.import(&from).failed();
    assert_eq!(imported.verdict("a.png"), ("created", ""));
    assert_eq!(served.stored("a.png").0, at(1.0, 2.0));
    assert!(imported.errors.contains("1 rows"), "{imported:#?}");
    assert!(!imported.errors.contains('\u{1b}'), "{imported:?}");
    let allowed = [&from[..], &["--allow-unmatched-rows"]].concat();
    served.import(&allowed).succeeded();
}

#[test]
fn names_with_positions_that_cannot_be_are_told() {
    let served = Served::new();
    let names = ["@48.85@2.29@.png", "@0261878@6243186@34@S@.png"];
    names.iter().for_each(|name| served.photo(name));
    let imported = served.import(&[]).succeeded();
    for name in names {
        assert_eq!(served.stored(name).0, Value::Null, "{name}");
        assert!(imported.line(name)["warning"].is_string(), "{imported:#?}");
        assert!(imported.errors.contains(name), "{imported:#?}");
    }
    assert!(
        imported.said.contains("2 names carry a doubtful position"),
        "{imported:#?}"
    );
}

#[test]
fn a_hostile_exif_block_does_not_end_an_import() {
    let served = Served::new();
    let count = u32::from(u16::MAX);
    let start = 8 + 2 + 12 * count + 4;
    let mut bomb = b"II*\0\x08\0\0\0\xff\xff".to_vec();
    for index in 0..count {
        bomb.extend([0x69, 0x87, 4, 0, 1, 0, 0, 0]);
        bomb.extend((start + index).to_le_bytes());
    }
    bomb.resize(bomb.len() + 865_539, 0xff);
    served.write("bare.jpg", &bomb);
    served.write(
        "hidden.png",
        &with_chunk(&picture("hidden"), b"eXIf", &bomb),
    );
    served.photo("z.png");
    let imported = served.import(&[]).failed();
    assert_eq!(imported.verdict("hidden.png"), ("created", ""));
    assert_eq!(imported.verdict("z.png"), ("created", ""));
    assert_eq!(
        imported.verdict("bare.jpg"),
        ("failed", "unsupported_media_type")
    );
}

#[test]
fn a_store_is_filled_and_updated_as_a_server_is() {
    if !has_model() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let photos = folder.path().join("photos");
    std::fs::create_dir(&photos).unwrap();
    let says = Says {
        position: Some((10.0, 20.0)),
        ..Says::default()
    };
    std::fs::write(photos.join("a.png"), png_with_exif(1, says)).unwrap();
    std::fs::write(photos.join("b.png"), picture("b")).unwrap();
    symlink("nowhere", photos.join("folder")).unwrap();
    std::fs::write(folder.path().join("p.csv"), "file,lat,lon\nb.png,1,2\n").unwrap();
    let import = words("import photos --map m --data data --report report.jsonl");
    let run = |more: &[&str]| {
        let output = placeformer(folder.path(), &[&import[..], more].concat());
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{errors}");
        String::from_utf8(output.stdout).unwrap()
    };
    assert!(run(&[]).contains("2 created, 0 already there, 0 failed, 1 ignored"));
    let said = run(&["--positions", "p.csv"]);
    assert!(
        said.contains("0 created, 1 updated, 1 already there"),
        "{said}"
    );
    let said = run(&["--positions", "p.csv"]);
    assert!(said.contains("0 created, 2 already there"), "{said}");
}
