//! `placeformer backup`: a copy of the store that another process is serving.

use crate::process::{Server, source};
use crate::support::{App, picture};
use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;

fn backup(data: &Path, out: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_placeformer"));
    command
        .env_remove("PLACEFORMER_CONFIG")
        .arg("backup")
        .arg("--data")
        .arg(data)
        .arg("--out")
        .arg(out);
    command.output().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_is_copied_while_it_is_served_and_after() {
    let data = tempfile::tempdir().unwrap();
    let path = data.path().to_owned();
    let (live, stopped) = (
        Arc::new(tempfile::tempdir().unwrap()),
        Arc::new(tempfile::tempdir().unwrap()),
    );
    let (to_live, to_stopped) = (live.path().to_owned(), stopped.path().to_owned());
    let outputs = tokio::task::spawn_blocking(move || {
        let server = Server::start(&path, None);
        let add = |seed: u64| {
            server
                .post(
                    &format!("/references?map=m&external_id={seed}"),
                    picture(seed),
                )
                .unwrap()
                .0
        };
        assert_eq!([0, 1, 2].map(add), [201; 3]);
        let of_live = backup(&path, &to_live);
        // The server went on undisturbed, and no earlier copy is ever overwritten.
        assert_eq!(add(3), 201);
        let again = backup(&path, &to_live);
        server.kill();
        [of_live, again, backup(&path, &to_stopped)]
    });
    let [of_live, again, of_stopped] = outputs.await.unwrap();
    for output in [&of_live, &of_stopped] {
        assert!(
            output.status.success(),
            "{}",
            String::from_utf8_lossy(&output.stderr)
        );
    }
    assert!(
        !again.status.success()
            && String::from_utf8_lossy(&again.stderr).contains("exists already")
    );
    for (copy, references) in [(live, 3), (stopped, 4)] {
        let app = App::open(copy, source(), |_| {});
        assert_eq!(app.count().await, references);
        let answer = app.post_png("/query?map=m&top_k=1", 2).await;
        assert_eq!(answer.ok()["results"][0]["external_id"], "2");
    }
}
