//! A whole service on a socket of its own.

use crate::support::{FakeSource, PATIENCE, open, until};
use placeformer::config::Config;
use placeformer::http::{AppState, Certificate, serve_encrypted};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use tempfile::TempDir;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tokio::time::timeout;

/// A server in the runtime of the test, which speaks HTTPS if its settings name a certificate.
pub struct Server {
    pub address: SocketAddr,
    pub source: Arc<FakeSource>,
    pub state: AppState,
    pub serving: JoinHandle<()>,
    stop: Option<oneshot::Sender<()>>,
    _directory: TempDir,
}

impl Server {
    pub async fn start(change: impl FnOnce(&mut Config)) -> Self {
        let (directory, source) = (tempfile::tempdir().unwrap(), FakeSource::new("fake-1"));
        let mut config = Config::default();
        config.store.reserve_bytes = 1 << 20;
        config.pipeline.disk_reserve_bytes = 0;
        change(&mut config);
        let certificate = Certificate::open(&config.http).await.unwrap();
        let (state, service) = open(directory.path(), source.clone(), config);
        state.open(service);
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let (stop, stopped) = oneshot::channel();
        let serving = serve_encrypted(listener, state.clone(), certificate, async {
            let _ = stopped.await;
        });
        Self {
            address,
            source,
            state,
            serving: tokio::spawn(serving),
            stop: Some(stop),
            _directory: directory,
        }
    }

    pub async fn connect(&self) -> TcpStream {
        TcpStream::connect(self.address).await.unwrap()
    }

    /// Connects as a client at another address of this machine.
    pub async fn connect_from(&self, address: &str) -> TcpStream {
        let address: IpAddr = address.parse().unwrap();
        let socket = TcpSocket::new_v4().unwrap();
        socket.bind(SocketAddr::new(address, 0)).unwrap();
        socket.connect(self.address).await.unwrap()
    }

    /// Connects as a client that has little room for answers that it does not read.
    pub async fn connect_narrowly(&self) -> TcpStream {
        let socket = TcpSocket::new_v4().unwrap();
        socket.set_recv_buffer_size(16 << 10).unwrap();
        socket.connect(self.address).await.unwrap()
    }

    /// Sends a whole request and reads to the end of the connection.
    pub async fn exchange(&self, request: &[u8]) -> String {
        exchange(self.connect().await, request).await
    }

    /// The value of a series now.
    pub fn metric(&self, series: &str) -> f64 {
        let text = self.state.metrics.render(|_| true).unwrap();
        let value = text
            .lines()
            .find_map(|line| line.strip_prefix(series)?.trim().parse().ok());
        value.unwrap_or_else(|| panic!("{series} is missing in\n{text}"))
    }

    /// Connections that were cut off for `reason`.
    pub fn cut(&self, reason: &str) -> f64 {
        self.metric(&format!(
            "placeformer_connections_cut_total{{reason=\"{reason}\"}}"
        ))
    }

    /// Connections of `kind` that are open.
    pub fn open(&self, kind: &str) -> f64 {
        self.metric(&format!("placeformer_connections{{kind=\"{kind}\"}}"))
    }

    /// Waits until so many connections of `kind` are open.
    pub async fn until_open(&self, kind: &str, count: usize) {
        let reached = || self.open(kind) == count as f64;
        until(&format!("{count} {kind} connections"), reached).await;
    }

    pub fn stop(&mut self) {
        self.stop.take().unwrap().send(()).unwrap();
    }
}

/// Sends a whole request and reads to the end of the connection.
pub async fn exchange(mut stream: TcpStream, request: &[u8]) -> String {
    stream.write_all(request).await.unwrap();
    read_all(&mut stream).await
}

pub async fn read_all(stream: &mut TcpStream) -> String {
    let mut text = Vec::new();
    // A reset after the answer is as good an end as any.
    let _ = timeout(PATIENCE, stream.read_to_end(&mut text))
        .await
        .expect("the server kept the connection");
    String::from_utf8_lossy(&text).into_owned()
}

pub fn post(path: &str, body: &[u8]) -> Vec<u8> {
    let head = format!(
        "POST {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\
         content-type: image/png\r\ncontent-length: {}\r\n\r\n",
        body.len()
    );
    [head.as_bytes(), body].concat()
}

/// A GET that ends the connection.
pub fn get(path: &str) -> Vec<u8> {
    format!("GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").into_bytes()
}

/// A GET that leaves the connection open.
pub fn get_and_stay(path: &str) -> Vec<u8> {
    format!("GET {path} HTTP/1.1\r\nhost: localhost\r\n\r\n").into_bytes()
}
