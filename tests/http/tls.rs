//! HTTPS: real handshakes with certificates that the tests make.

use crate::listener::{Server, read_all};
use crate::support::{PATIENCE, until};
use placeformer::http::{Certificate, HttpConfig};
use rcgen::{CertifiedKey, KeyPair, generate_simple_self_signed};
use reqwest::{Client, Version};
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;
use tempfile::TempDir;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};

/// A folder with a certificate for `localhost` and its key.
struct Files(TempDir);

impl Files {
    fn new() -> Self {
        // This fails only if a provider is installed already, which is as good.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let files = Self(tempfile::tempdir().unwrap());
        files.renew();
        files
    }

    /// Puts another certificate in place, as a rename does.
    fn renew(&self) -> CertifiedKey<KeyPair> {
        let made = generate_simple_self_signed(["localhost".to_owned()]).unwrap();
        self.replace("key.pem", &made.signing_key.serialize_pem());
        self.replace("cert.pem", &made.cert.pem());
        made
    }

    fn replace(&self, name: &str, content: &str) {
        let next = self.0.path().join("next");
        std::fs::write(&next, content).unwrap();
        std::fs::rename(next, self.0.path().join(name)).unwrap();
    }

    fn settings(&self, http: &mut HttpConfig) {
        http.tls_cert = Some(self.0.path().join("cert.pem"));
        http.tls_key = Some(self.0.path().join("key.pem"));
    }

    /// A client that trusts the certificate which is in place now.
    fn client(&self) -> Client {
        let pem = std::fs::read(self.0.path().join("cert.pem")).unwrap();
        let certificate = reqwest::Certificate::from_pem(&pem).unwrap();
        Client::builder()
            .tls_certs_only([certificate])
            .pool_max_idle_per_host(0)
            .timeout(PATIENCE)
            .build()
            .unwrap()
    }
}

fn url(server: &Server, path: &str) -> String {
    format!("https://localhost:{}{path}", server.address.port())
}

async fn is_trusted(client: &Client, server: &Server) -> bool {
    let answer = client.get(url(server, "/livez")).send().await;
    answer.is_ok_and(|answer| answer.status() == 200)
}

/// Waits until `client` trusts the server.
async fn until_trusted(client: &Client, server: &Server) {
    let began = std::time::Instant::now();
    while !is_trusted(client, server).await {
        assert!(
            began.elapsed() < PATIENCE,
            "the certificate was never read again"
        );
        sleep(Duration::from_millis(50)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn requests_are_answered_over_https_and_only_to_clients_that_trust_it() {
    let files = Files::new();
    let server = Server::start(|config| files.settings(&mut config.http)).await;
    let client = files.client();
    let answer = client.get(url(&server, "/maps")).send().await.unwrap();
    assert_eq!(
        (answer.status().as_u16(), answer.version()),
        (200, Version::HTTP_11)
    );
    let large = client.get(url(&server, "/docs/swagger-ui-bundle.js"));
    let large = large.send().await.unwrap().bytes().await.unwrap();
    assert!(large.len() > 100_000);
    let own = client.get(url(&server, "/maps"));
    let origin = format!("https://localhost:{}", server.address.port());
    let own = own.header("origin", origin).send().await.unwrap();
    assert_eq!(own.status(), 200);
    let foreign = client.get(url(&server, "/maps"));
    let foreign = foreign
        .header("origin", "https://evil.example")
        .send()
        .await
        .unwrap();
    assert_eq!(foreign.status(), 403);

    let stranger = Files::new().client();
    assert!(!is_trusted(&stranger, &server).await);
    until("the count of the handshake", || {
        server.cut("handshake") >= 1.0
    })
    .await;
    let mut plain = server.connect().await;
    plain
        .write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n")
        .await
        .unwrap();
    assert!(!read_all(&mut plain).await.contains("live"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_new_certificate_is_taken_up_and_a_broken_one_is_not() {
    let files = Files::new();
    let server = Server::start(|config| files.settings(&mut config.http)).await;
    let first = files.client();
    assert!(is_trusted(&first, &server).await);
    files.renew();
    let second = files.client();
    until_trusted(&second, &server).await;
    assert!(!is_trusted(&first, &server).await);

    // A chain without its key, no chain at all, and no file.
    let other = generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    for broken in [other.cert.pem(), "no certificate".to_owned(), String::new()] {
        files.replace("cert.pem", &broken);
        hang_up(&server).await;
        assert!(is_trusted(&second, &server).await);
    }
    std::fs::remove_file(files.0.path().join("cert.pem")).unwrap();
    hang_up(&server).await;
    assert!(is_trusted(&second, &server).await);
    files.renew();
    until_trusted(&files.client(), &server).await;
}

/// Sends this process SIGHUP, and gives the server time to read its files.
async fn hang_up(server: &Server) {
    let mut kill = Command::new("sh");
    let sent = kill.args(["-c", "kill -HUP $PPID"]).status().unwrap();
    assert!(sent.success());
    sleep(Duration::from_millis(300)).await;
    assert!(!server.serving.is_finished());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn handshakes_that_dawdle_end_and_do_not_keep_their_place() {
    let files = Files::new();
    let server = Server::start(|config| {
        files.settings(&mut config.http);
        config.http.header_timeout_ms = 300;
    })
    .await;
    let mut silent = server.connect().await;
    assert_eq!(read_all(&mut silent).await, "");
    assert_eq!(server.cut("handshake"), 1.0);

    let server = Server::start(|config| {
        files.settings(&mut config.http);
        config.http.max_connections = 4;
    })
    .await;
    let mut crowd: Vec<TcpStream> = Vec::new();
    for _ in 0..40 {
        let mut stream = server.connect().await;
        // The first bytes of a handshake, no more.
        stream.write_all(&[22, 3, 1, 2, 0]).await.unwrap();
        crowd.push(stream);
    }
    assert!(is_trusted(&files.client(), &server).await);
    assert!(server.open("general") <= 4.0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn encrypted_answers_that_nobody_reads_end_the_connection() {
    let files = Files::new();
    let server = Server::start(|config| {
        files.settings(&mut config.http);
        config.http.answer_stall_timeout_ms = 300;
    })
    .await;
    let client = files.client();
    let mut held = Vec::new();
    for _ in 0..2 {
        let request = client.get(url(&server, "/docs/swagger-ui-bundle.js"));
        let answer = request.header("accept-encoding", "identity").send();
        held.push(timeout(PATIENCE, answer).await.unwrap().unwrap());
    }
    // The client's own buffers take some of it; nobody asks for the rest.
    until("the end of what nobody reads", || {
        server.open("general") == 0.0
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn commands_reach_the_server_with_the_certificate_they_are_given() {
    let files = Files::new();
    let server = Server::start(|config| files.settings(&mut config.http)).await;
    let certificate = files.0.path().join("cert.pem");
    let certificate = certificate.to_str().unwrap();
    let given = run(&server, &["healthcheck", "--ca-cert", certificate], None).await;
    assert!(given.status.success(), "{given:?}");
    let given = run(&server, &["map", "list"], Some(certificate)).await;
    assert!(given.status.success(), "{given:?}");
    let unknown = run(&server, &["healthcheck"], None).await;
    assert!(!unknown.status.success(), "{unknown:?}");
    let key = files.0.path().join("key.pem");
    let wrong = run(&server, &["healthcheck"], key.to_str()).await;
    let error = String::from_utf8(wrong.stderr).unwrap();
    assert!(
        error.contains("there is no certificate (PEM) in"),
        "{error}"
    );
}

/// Runs a command that asks `server`, with `certificate` in its environment.
async fn run(server: &Server, arguments: &[&str], certificate: Option<&str>) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_placeformer"));
    command
        .args(arguments)
        .env("PLACEFORMER_SERVER", url(server, ""));
    if let Some(file) = certificate {
        command.env("PLACEFORMER_CA_CERT", file);
    }
    let running = tokio::task::spawn_blocking(move || command.output());
    running.await.unwrap().unwrap()
}

#[tokio::test]
async fn certificates_that_cannot_be_used_are_named() {
    let files = Files::new();
    let refusal = |certificate: &Path, key: &Path| {
        let config = HttpConfig {
            tls_cert: Some(certificate.to_owned()),
            tls_key: Some(key.to_owned()),
            ..HttpConfig::default()
        };
        async move {
            match Certificate::open(&config).await {
                Ok(_) => panic!("{config:?} was taken"),
                Err(error) => error.to_string(),
            }
        }
    };
    let (certificate, key) = (
        files.0.path().join("cert.pem"),
        files.0.path().join("key.pem"),
    );
    let missing = files.0.path().join("missing.pem");
    for (certificate, key, said) in [
        (&missing, &key, "cannot read the certificate chain"),
        (&certificate, &missing, "cannot read the private key"),
        (&key, &key, "there is no certificate in"),
        (&certificate, &certificate, "cannot read the private key"),
    ] {
        let error = refusal(certificate, key).await;
        assert!(error.contains(said), "{error}");
    }
    let other = Files::new();
    let error = refusal(&certificate, &other.0.path().join("key.pem")).await;
    assert!(error.contains("cannot be used with the key"), "{error}");
}
