//! Where a server may listen without keys.

use crate::common::program::{offline, refused_by};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

/// A key that may write, as a setting.
const KEYS: &str = "[{name=\"fleet\", role=\"write\", \
    sha256=\"2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b\"}]";

fn serve(folder: &Path, listen: &str) -> Command {
    offline(folder, &["serve", "--data", "store", "--listen", listen])
}

/// What `command` says first. It has no model, so that it ends by itself.
fn announcement(mut command: Command) -> String {
    let child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
    let mut child = child.expect("the binary was built");
    let mut line = String::new();
    let stdout = child.stdout.take().unwrap();
    BufReader::new(stdout).read_line(&mut line).unwrap();
    let _ = child.kill();
    child.wait().unwrap();
    line
}

#[test]
fn without_keys_other_machines_are_let_in_only_by_an_explicit_word() {
    let folder = tempfile::tempdir().unwrap();
    for listen in ["0.0.0.0:0", "[::]:0", "[::ffff:0.0.0.0]:0"] {
        let error = refused_by(&mut serve(folder.path(), listen));
        for named in [
            listen,
            "auth.keys",
            "127.0.0.1",
            "--insecure",
            "http.insecure",
        ] {
            assert!(error.contains(named), "{named} is missing in {error}");
        }
    }
    let mut by_variable = offline(folder.path(), &["serve", "--data", "store"]);
    by_variable.env("PLACEFORMER_HTTP__LISTEN", "0.0.0.0:0");
    assert!(refused_by(&mut by_variable).contains("--insecure"));

    let mut by_flag = serve(folder.path(), "0.0.0.0:0");
    by_flag.arg("--insecure");
    let mut by_setting = serve(folder.path(), "0.0.0.0:0");
    by_setting.env("PLACEFORMER_HTTP__INSECURE", "true");
    let mut by_keys = serve(folder.path(), "0.0.0.0:0");
    by_keys.env("PLACEFORMER_AUTH__KEYS", KEYS);
    for command in [by_flag, by_setting, by_keys] {
        let said = announcement(command);
        assert!(said.starts_with("listening on http://0.0.0.0:"), "{said}");
    }
    for listen in ["127.0.0.1:0", "localhost:0", "127.1.2.3:0"] {
        let said = announcement(serve(folder.path(), listen));
        assert!(said.starts_with("listening on http://"), "{said}");
    }
}

#[test]
fn the_word_is_a_setting_that_is_printed() {
    let folder = tempfile::tempdir().unwrap();
    for (arguments, printed) in [
        (&["serve", "--print-config"][..], "\ninsecure = false\n"),
        (
            &["serve", "--print-config", "--insecure"],
            "\ninsecure = true\n",
        ),
    ] {
        let output = offline(folder.path(), arguments).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(text.contains(printed), "{text}");
    }
}

#[test]
fn a_certificate_that_cannot_be_used_keeps_the_server_from_starting() {
    let folder = tempfile::tempdir().unwrap();
    let mut missing = serve(folder.path(), "127.0.0.1:0");
    missing
        .env("PLACEFORMER_HTTP__TLS_CERT", "cert.pem")
        .env("PLACEFORMER_HTTP__TLS_KEY", "key.pem");
    let error = refused_by(&mut missing);
    assert!(
        error.contains("cannot read the certificate chain cert.pem"),
        "{error}"
    );
    let mut half = serve(folder.path(), "127.0.0.1:0");
    half.env("PLACEFORMER_HTTP__TLS_CERT", "cert.pem");
    let error = refused_by(&mut half);
    assert!(
        error.contains("http.tls_cert and http.tls_key belong together"),
        "{error}"
    );
}
