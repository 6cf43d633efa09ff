use super::*;
use std::os::unix::fs::symlink;
use std::os::unix::net::UnixListener;

fn folder_of(names: &[&str]) -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    for name in names {
        let path = root.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, b"x").unwrap();
    }
    root
}

fn names(images: &[(String, PathBuf)]) -> Vec<&str> {
    images.iter().map(|(name, _)| name.as_str()).collect()
}

/// What was passed over: name, code, and whether photos may be lost by that.
fn passed(scan: &FolderScan) -> Vec<(&str, &str, bool)> {
    let passed = scan.passed_over.iter();
    passed
        .map(|entry| (entry.name.as_str(), entry.reason.code(), entry.is_loss))
        .collect()
}

#[test]
fn images_are_listed_by_name_whatever_their_case_and_depth() {
    let root = folder_of(&[
        "b/2.JPG",
        "a.png",
        "b/1.jpeg",
        "notes.txt",
        ".hidden/x.jpg",
        "b/.y.jpg",
        "b/@eaDir/1.jpeg/SYNOPHOTO_THUMB_M.jpg",
        "c.jfif",
        "c.JPE",
        "z.webp",
    ]);
    let images = list_images(root.path()).unwrap();
    let expected = ["a.png", "b/1.jpeg", "b/2.JPG", "c.JPE", "c.jfif", "z.webp"];
    assert_eq!(names(&images), expected);
    assert_eq!(scan_folder(root.path()).unwrap().images, images);
}

#[test]
fn a_missing_folder_is_named_in_one_line() {
    for name in ["/nowhere/at/all", "/no\nwhere"] {
        for error in [
            list_images(Path::new(name)).unwrap_err(),
            scan_folder(Path::new(name)).unwrap_err(),
        ] {
            let error = error.to_string();
            assert!(error.contains(&name.replace('\n', "\\n")), "{error}");
        }
    }
}

#[test]
fn a_scan_says_of_everything_why_it_is_no_image() {
    let root = folder_of(&[
        "a.jpg",
        "b.HEIC",
        "clip.mp4",
        "README",
        "._a.jpg",
        ".DS_Store",
        "Thumbs.db",
        "@eaDir/a.jpg/thumb.jpg",
        "lost+found/x.jpg",
        "sub/c.jpg",
    ]);
    let path = |name: &str| root.path().join(name);
    symlink("nowhere.jpg", path("dangling.jpg")).unwrap();
    symlink("nowhere", path("dangling")).unwrap();
    symlink("loop.jpg", path("loop.jpg")).unwrap();
    symlink("sub", path("linked")).unwrap();
    symlink("../sub", path("sub/cycle")).unwrap();
    symlink("a.jpg", path("other_name.jpg")).unwrap();
    symlink("/dev/null", path("null.jpg")).unwrap();
    let _socket = UnixListener::bind(path("socket.jpg")).unwrap();
    let scan = scan_folder(root.path()).unwrap();
    assert_eq!(
        names(&scan.images),
        ["a.jpg", "other_name.jpg", "sub/c.jpg"]
    );
    let expected = [
        (".DS_Store", "hidden", false),
        ("._a.jpg", "resource_fork", false),
        ("@eaDir", "system_entry", false),
        ("README", "unsupported_file", false),
        ("Thumbs.db", "system_entry", false),
        ("b.HEIC", "unsupported_file", false),
        ("clip.mp4", "unsupported_file", false),
        ("dangling", "broken_link", false),
        ("dangling.jpg", "broken_link", true),
        ("linked", "linked_folder", false),
        ("loop.jpg", "broken_link", true),
        ("lost+found", "system_entry", false),
        ("null.jpg", "special_file", true),
        ("socket.jpg", "special_file", true),
        ("sub/cycle", "linked_folder", false),
    ];
    assert_eq!(passed(&scan), expected);
}

#[test]
fn a_file_is_an_image_whatever_its_name_and_a_device_is_none() {
    let root = folder_of(&["IMG_0001"]);
    let file = root.path().join("IMG_0001");
    let scan = scan_folder(&file).unwrap();
    assert_eq!(scan.images, [("IMG_0001".to_owned(), file)]);
    let error = scan_folder(Path::new("/dev/null")).unwrap_err();
    assert!(error.to_string().contains("neither"), "{error}");
}
