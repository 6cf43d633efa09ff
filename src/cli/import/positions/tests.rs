use super::*;
use std::path::PathBuf;

fn photos(names: &[&str]) -> Vec<(String, PathBuf)> {
    let photo = |name: &&str| ((*name).to_owned(), PathBuf::from(name));
    names.iter().map(photo).collect()
}

fn read_bytes(csv: &[u8], names: &[&str]) -> anyhow::Result<Positions> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("positions.csv");
    std::fs::write(&path, csv).unwrap();
    Positions::read(&path, folder.path(), &photos(names), None)
}

fn read(csv: &str) -> anyhow::Result<Positions> {
    read_bytes(csv.as_bytes(), &["a.jpg", "b.jpg"])
}

fn place(positions: &Positions, photo: &str) -> Option<(f64, f64)> {
    let location = positions.row(photo).location?;
    Some((location.lat(), location.lon()))
}

#[test]
fn tables_of_every_dialect_are_read() {
    for csv in [
        "file,lat,lon\na.jpg,48.85,2.29\n",
        "file,lat,lon\r\na.jpg,48.85,2.29\r\n\r\n",
        "File;Latitude;Longitude\na.jpg;48,85;2,29\n;;\n",
        "sep=;\nFile;Latitude;Longitude\na.jpg;48,85;2,29\n",
        "\u{feff}FILENAME\tLAT\tLNG\na.jpg\t48,85\t2,29\n",
        "image|y|x\na.jpg|48.85|2.29\n",
        "SourceFile,GPS Latitude,GPS Longitude\n\"a.jpg\",\"48,85\",\" 2.29 \"\n",
        "id,Image_Name,notes,LAT,Long,quality\n7,a.jpg,\"x, \"\"y\"\"\",48.85,2.29,1\n",
        "lon,lat,key\n2.29,48.85,a.jpg,,\n",
        "name,path,lat,lon\nnothing,a.jpg,48.85,2.29\n",
    ] {
        let positions = read(csv).unwrap();
        assert_eq!(place(&positions, "a.jpg"), Some((48.85, 2.29)), "{csv}");
        assert!(positions.unmatched.is_empty(), "{csv}");
    }
    let positions = read("file,lat,lon,junk,more\na.jpg,1,2,3,4\n").unwrap();
    assert!(
        positions.columns.contains("2 other columns"),
        "{}",
        positions.columns
    );
}

#[test]
fn utf_16_is_read_with_a_mark_and_without() {
    let text = "file;lat;lon\na.jpg;48,85;2,29\ncaf\u{e9}.jpg;1;2\n";
    let units: Vec<u16> = text.encode_utf16().collect();
    let little: Vec<u8> = units.iter().flat_map(|unit| unit.to_le_bytes()).collect();
    let big: Vec<u8> = units.iter().flat_map(|unit| unit.to_be_bytes()).collect();
    let marked_little = [b"\xff\xfe".as_slice(), &little].concat();
    let marked_big = [b"\xfe\xff".as_slice(), &big].concat();
    for bytes in [&little, &big, &marked_little, &marked_big] {
        let positions = read_bytes(bytes, &["a.jpg", "caf\u{e9}.jpg"]).unwrap();
        assert_eq!(place(&positions, "a.jpg"), Some((48.85, 2.29)));
        assert_eq!(place(&positions, "caf\u{e9}.jpg"), Some((1.0, 2.0)));
    }
    let odd = &marked_little[..marked_little.len() - 1];
    for bytes in [odd, b"file,lat,lon\ncaf\xe9.jpg,1,2\n", b"\xff\xfe\x00\xd8"] {
        assert!(read_bytes(bytes, &["a.jpg"]).is_err());
    }
}

#[test]
fn rows_find_their_photo_however_they_spell_it() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let photos_folder = root.join("photos");
    std::fs::create_dir(&photos_folder).unwrap();
    let absolute = photos_folder.join("sub/a.jpg");
    let absolute = absolute.to_str().unwrap();
    let path = root.join("positions.csv");
    let names = photos(&["sub/a.jpg", "b.jpg", "x/b.jpg", "caf\u{e9}.jpg"]);
    for (spelling, found) in [
        ("sub/a.jpg", Some("sub/a.jpg")),
        ("./sub/a.jpg", Some("sub/a.jpg")),
        (".\\sub\\a.jpg", Some("sub/a.jpg")),
        ("sub//../sub/./a.jpg", Some("sub/a.jpg")),
        (absolute, Some("sub/a.jpg")),
        ("photos/sub/a.jpg", Some("sub/a.jpg")),
        ("../photos/sub/a.jpg", None),
        ("a.jpg", Some("sub/a.jpg")),
        ("/home/else/where/sub/a.jpg", Some("sub/a.jpg")),
        ("C:\\photos\\sub\\a.jpg", Some("sub/a.jpg")),
        ("other/a.jpg", None),
        ("b.jpg", Some("b.jpg")),
        ("x/b.jpg", Some("x/b.jpg")),
        ("y/b.jpg", None),
        ("/elsewhere/b.jpg", None),
        ("cafe\u{301}.jpg", Some("caf\u{e9}.jpg")),
        ("caf\u{e9}.jpg", Some("caf\u{e9}.jpg")),
        ("missing.jpg", None),
    ] {
        std::fs::write(&path, format!("file,lat,lon\n{spelling},1,2\n")).unwrap();
        let positions = Positions::read(&path, &photos_folder, &names, None).unwrap();
        let rows: Vec<&str> = positions.rows.keys().map(String::as_str).collect();
        assert_eq!(rows, Vec::from_iter(found), "{spelling}");
        assert_eq!(
            positions.unmatched.len(),
            usize::from(found.is_none()),
            "{spelling}"
        );
    }
}

#[test]
fn rows_for_another_folder_are_no_rows_that_match_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("positions.csv");
    let csv = "file,lat,lon\ndatabase/a.jpg,1,2\nb.jpg,3,4\nqueries/b.jpg,5,6\nqueries/d.jpg,7,8\n";
    std::fs::write(&path, csv).unwrap();
    for name in ["database/a.jpg", "queries/b.jpg"] {
        let file = folder.path().join(name);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(file, b"x").unwrap();
    }
    let names = photos(&["a.jpg", "b.jpg"]);
    let database = folder.path().join("database");
    let positions = Positions::read(&path, &database, &names, None).unwrap();
    assert_eq!(place(&positions, "a.jpg"), Some((1.0, 2.0)));
    assert_eq!(place(&positions, "b.jpg"), Some((3.0, 4.0)));
    assert_eq!(positions.elsewhere, 1);
    assert_eq!(Vec::from_iter(&positions.unmatched), ["queries/d.jpg"]);
}

#[test]
fn times_need_an_offset_or_a_zone() {
    let csv = b"file,captured_at\na.jpg,2026-07-01 12:00:00\n";
    let error = read_bytes(csv, &["a.jpg"]).unwrap_err();
    assert!(format!("{error:#}").contains("--timezone"), "{error:#}");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("positions.csv");
    std::fs::write(&path, csv).unwrap();
    let zone: ClockZone = "Europe/Paris".parse().unwrap();
    let names = photos(&["a.jpg"]);
    let positions = Positions::read(&path, folder.path(), &names, Some(&zone)).unwrap();
    let time = positions.row("a.jpg").captured_at.unwrap();
    assert_eq!(time.to_string(), "2026-07-01T10:00:00Z");
}

#[test]
fn damaged_rows_are_named_by_line() {
    for (csv, part) in [
        ("file,lat,lon\na.jpg,95,0\n", "line 2"),
        ("file,lat,lon\na.jpg,1,\n", "both or not at all"),
        ("file,lat,lon\na.jpg,north,2\n", "\"north\""),
        ("file,lat,lon\na.jpg,\"1,234,5\",2\n", "1,234,5"),
        ("file,lat,lon\na.jpg,48,85,2,29\n", "5 fields"),
        ("file,lat,lon\na.jpg,1\n", "2 fields"),
        ("file,lat,lon\n,1,2\n", "file is empty"),
        ("file,captured_at\na.jpg,yesterday\n", "RFC 3339"),
        (
            "file,captured_at\na.jpg,9999-12-31T23:00:00-02:00\n",
            "9999",
        ),
        ("file,latitude\na.jpg,1\n", "latitude"),
        ("lat,lon\n1,2\n", "\"file\""),
        ("file,lattitude,longtitude\na.jpg,1,2\n", "no column"),
        ("", "\"file\""),
        ("file,lat,lon\na.jpg,1,2\na.jpg,1,2\n", "line 3"),
        ("file,lat,lon\na.jpg,1,2\n./a.jpg,1,2\n", "line 3"),
        ("file,lat,lon\nc.jpg,1,2\nc.jpg,1,2\n", "line 3"),
    ] {
        let error = read(csv).err().unwrap();
        assert!(format!("{error:#}").contains(part), "{csv}: {error:#}");
    }
}
