//! A whole service without weights: a real store in a temporary directory, the real surface, and a
//! descriptor source that derives everything from the image's content.

use super::noise;
use axum::body::Body;
use axum::http::{HeaderMap, Request, StatusCode};
use axum::response::Response;
use http_body_util::BodyExt;
use placeformer::config::Config;
use placeformer::http::{AppState, app, serve};
use placeformer::ops::{Health, Metrics};
use placeformer::pipeline::{DescriptorSource, Parts, Service};
use placeformer_core::types::{
    Descriptor, GLOBAL_DIM, ImageSize, ImageTensor, KeyPatches, ModelId, PatchGrid, PoolingStride,
    ScaleKeyPatches,
};
use placeformer_store::{PlaceStore, SqliteStore, StoreConfig};
use placeformer_track::{KEY_BYTES, TrackKey};
use placeformer_vision::extract::pack;
use placeformer_vision::extract::{Aggregate, ExtractError, Head};
use placeformer_vision::image::{ImageConfig, ImageError, load_tensor};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde_json::Value;
use std::future::pending;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;
use tempfile::TempDir;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tower::ServiceExt;

/// Size the fake model asks for.
pub const SIZE: ImageSize = ImageSize {
    width: 112,
    height: 84,
};

/// Bytes over which the fake source panics while it decodes.
pub const BREAKS_THE_DECODER: &[u8] = b"this breaks the decoder";
/// Bytes over which the fake source panics while it describes.
pub const BREAKS_THE_MODEL: &[u8] = b"this breaks the model";

/// Descriptors from content alone: equal images are equal, different ones as unrelated as random
/// vectors.
pub struct FakeSource {
    model: ModelId,
    head: Option<Head>,
    /// Images described so far.
    pub described: AtomicUsize,
    delay: Mutex<Duration>,
    /// While true, a description that began alone goes on, and pauses again and again.
    pub long: AtomicBool,
    pub decoding: Step,
    pub describing: Step,
}

/// One step of the source: how many are in it, and whether they may leave.
#[derive(Default)]
pub struct Step {
    pub gate: Gate,
    inside: AtomicUsize,
    peak: AtomicUsize,
}

impl Step {
    fn run<T>(&self, work: impl FnOnce() -> T) -> T {
        let _inside = Inside::enter(self);
        self.gate.pass();
        work()
    }

    /// Calls under way.
    pub fn inside(&self) -> usize {
        self.inside.load(Ordering::SeqCst)
    }

    /// Most calls ever under way at once.
    pub fn peak(&self) -> usize {
        self.peak.load(Ordering::SeqCst)
    }
}

/// One call under way, also if it ends by a panic.
struct Inside<'a>(&'a Step);

impl<'a> Inside<'a> {
    fn enter(step: &'a Step) -> Self {
        step.peak.fetch_max(
            step.inside.fetch_add(1, Ordering::SeqCst) + 1,
            Ordering::SeqCst,
        );
        Self(step)
    }
}

impl Drop for Inside<'_> {
    fn drop(&mut self) {
        self.0.inside.fetch_sub(1, Ordering::SeqCst);
    }
}

/// Where threads wait while it is closed.
#[derive(Default)]
pub struct Gate {
    closed: Mutex<bool>,
    moved: Condvar,
}

impl Gate {
    pub fn close(&self) {
        *self.closed.lock().unwrap() = true;
    }

    pub fn open(&self) {
        *self.closed.lock().unwrap() = false;
        self.moved.notify_all();
    }

    /// Waits until it is open. A test that failed meanwhile opens nothing, and must end all the
    /// same.
    pub fn pass(&self) {
        let closed = self.closed.lock().unwrap();
        drop(
            self.moved
                .wait_timeout_while(closed, 2 * PATIENCE, |closed| *closed)
                .unwrap(),
        );
    }
}

/// Longer than anything here should take.
pub const PATIENCE: Duration = Duration::from_secs(30);

/// Waits until `condition` holds.
pub fn until(what: &str, condition: impl Fn() -> bool) -> impl Future<Output = ()> {
    let what = what.to_owned();
    let began = std::time::Instant::now();
    async move {
        while !condition() {
            assert!(began.elapsed() < PATIENCE, "{what} never came about");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }
}

impl FakeSource {
    pub fn new(model: &str) -> Arc<Self> {
        Self::made(ModelId::new(model), None)
    }

    /// A source whose global descriptors are its pooled tokens, projected by `head`.
    pub fn with_head(head: Head) -> Arc<Self> {
        let headless = ModelId::new(format!("{BACKBONE}:{SIZE}:t1:k48-12-4:hnone"));
        Self::made(head.rebind(&headless).unwrap(), Some(head))
    }

    fn made(model: ModelId, head: Option<Head>) -> Arc<Self> {
        Arc::new(Self {
            model,
            head,
            described: AtomicUsize::new(0),
            delay: Mutex::default(),
            long: AtomicBool::new(false),
            decoding: Step::default(),
            describing: Step::default(),
        })
    }

    /// Lets every further description take this long.
    pub fn slow_down(&self, delay: Duration) {
        *self.delay.lock().unwrap() = delay;
    }

    pub fn described(&self) -> usize {
        self.described.load(Ordering::SeqCst)
    }
}

impl DescriptorSource for FakeSource {
    fn model_id(&self) -> &ModelId {
        &self.model
    }

    fn head(&self) -> Option<&Head> {
        self.head.as_ref()
    }

    fn input_size(&self) -> ImageSize {
        SIZE
    }

    fn decode(&self, bytes: &[u8], config: &ImageConfig) -> Result<ImageTensor, ImageError> {
        self.decoding.run(|| match bytes {
            BREAKS_THE_DECODER => panic!("planted in the decoder"),
            BREAKS_THE_MODEL => Ok(ImageTensor {
                size: SIZE,
                data: vec![f32::NAN; 3 * 112 * 84],
            }),
            _ => load_tensor(bytes, config, SIZE),
        })
    }

    fn describe(&self, images: &[ImageTensor]) -> Result<Vec<Descriptor>, ExtractError> {
        self.describe_with_pauses(images, &|| ())
    }

    fn describe_with_pauses(
        &self,
        images: &[ImageTensor],
        pause: &dyn Fn(),
    ) -> Result<Vec<Descriptor>, ExtractError> {
        let is_alone = self.describing.inside() == 0;
        self.describing.run(|| {
            while is_alone && self.long.load(Ordering::SeqCst) {
                pause();
                std::thread::sleep(Duration::from_millis(1));
            }
            self.described.fetch_add(images.len(), Ordering::SeqCst);
            assert!(
                images.iter().all(|image| !image.data[0].is_nan()),
                "planted in the model"
            );
            let delay = *self.delay.lock().unwrap();
            std::thread::sleep(delay);
            let mut descriptors: Vec<Descriptor> = images.iter().map(describe).collect();
            if let Some(head) = &self.head {
                descriptors
                    .iter_mut()
                    .for_each(|descriptor| descriptor.global = head.project(&descriptor.pooled));
            }
            Ok(descriptors)
        })
    }

    fn memory_bytes(&self) -> u64 {
        0
    }
}

/// The backbone that the fake tokens pretend to come from.
pub const BACKBONE: &str = "fake:0123456789ab:b8";

/// A head for `backbone`, drawn from `seed`.
pub fn head(seed: u64, backbone: &str, aggregate: Aggregate) -> Head {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let weight = noise::values(&mut rng, GLOBAL_DIM * 384, 1.0);
    Head::new(
        aggregate,
        weight,
        vec![0.0; GLOBAL_DIM],
        backbone,
        [].into(),
    )
    .unwrap()
}

/// The bytes of its file.
pub fn file_of(head: &Head) -> Vec<u8> {
    let file = tempfile::NamedTempFile::new().unwrap();
    head.save(file.path()).unwrap();
    std::fs::read(file.path()).unwrap()
}

fn describe(image: &ImageTensor) -> Descriptor {
    let bytes: Vec<u8> = image
        .data
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect();
    let mut rng = ChaCha8Rng::seed_from_u64(u64::from(crc32fast::hash(&bytes)));
    let mut unit = |dim: usize| {
        let raw = noise::values(&mut rng, dim, 1.0);
        let norm = raw.iter().map(|v| v * v).sum::<f32>().sqrt();
        raw.into_iter().map(|v| v / norm).collect::<Vec<f32>>()
    };
    let global = unit(GLOBAL_DIM);
    let pooled = unit(384);
    let grid = PatchGrid {
        columns: 8,
        rows: 6,
        patch_px: 14,
        stride: PoolingStride::Kernel,
    };
    let mut scale = |count: u32| ScaleKeyPatches {
        index: (0..count).collect(),
        attention: (0..count).map(|i| 2.0 - i as f32 / 100.0).collect(),
        descriptors: (0..count).flat_map(|_| unit(384)).collect(),
    };
    let patches = KeyPatches {
        grid,
        dim: 384,
        scales: [scale(48), scale(12), scale(4)],
    };
    Descriptor {
        global,
        pooled,
        patches: pack(&patches),
    }
}

/// A running application.
pub struct App {
    pub router: axum::Router,
    pub state: AppState,
    pub source: Arc<FakeSource>,
    pub directory: Arc<TempDir>,
}

impl App {
    pub fn new() -> Self {
        Self::with(|_| {})
    }

    pub fn with(change: impl FnOnce(&mut Config)) -> Self {
        Self::open(
            Arc::new(tempfile::tempdir().unwrap()),
            FakeSource::new("fake-1"),
            change,
        )
    }

    pub fn open(
        directory: Arc<TempDir>,
        source: Arc<FakeSource>,
        change: impl FnOnce(&mut Config),
    ) -> Self {
        Self::around(|store| Arc::new(store), directory, source, change)
    }

    /// Serves behind a socket for as long as `runtime` lives; returns the URL.
    pub fn listen(&self, runtime: &Runtime) -> String {
        let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        runtime.spawn(serve(listener, self.state.clone(), pending()));
        url
    }

    /// With a store of the test's own around the real one.
    pub fn around(
        wrap: impl FnOnce(SqliteStore) -> Arc<dyn PlaceStore>,
        directory: Arc<TempDir>,
        source: Arc<FakeSource>,
        change: impl FnOnce(&mut Config),
    ) -> Self {
        let store = StoreConfig {
            reserve_bytes: 1 << 20,
            ..Default::default()
        };
        let mut config = Config {
            store,
            ..Default::default()
        };
        config.pipeline.disk_reserve_bytes = 0;
        change(&mut config);
        let store = wrap(SqliteStore::open(directory.path(), &config.store).unwrap());
        let (state, service) = start(store, source.clone(), config);
        state.open(service);
        Self {
            router: app(state.clone()),
            state,
            source,
            directory,
        }
    }

    pub async fn send(&self, request: Request<Body>) -> Answer {
        Answer::of(self.router.clone().oneshot(request).await.unwrap()).await
    }

    pub async fn get(&self, path: &str) -> Answer {
        self.send(Request::get(path).body(Body::empty()).unwrap())
            .await
    }

    pub async fn delete(&self, path: &str) -> Answer {
        self.send(Request::delete(path).body(Body::empty()).unwrap())
            .await
    }

    pub async fn post(&self, path: &str, kind: &str, body: impl Into<Body>) -> Answer {
        self.send(
            Request::post(path)
                .header("content-type", kind)
                .body(body.into())
                .unwrap(),
        )
        .await
    }

    pub async fn post_png(&self, path: &str, seed: u64) -> Answer {
        self.post(path, "image/png", picture(seed)).await
    }

    pub async fn put(&self, path: &str, kind: &str, body: impl Into<Body>) -> Answer {
        self.send(
            Request::put(path)
                .header("content-type", kind)
                .body(body.into())
                .unwrap(),
        )
        .await
    }

    /// Sends bytes as a JPEG.
    pub async fn post_bytes(&self, path: &str, bytes: &[u8]) -> Answer {
        self.post(path, "image/jpeg", bytes.to_vec()).await
    }

    /// The value of a series, as the metrics show it.
    pub async fn metric(&self, series: &str) -> f64 {
        let text = self.get("/metrics").await.text;
        let value = text
            .lines()
            .find_map(|line| line.strip_prefix(series)?.trim().parse().ok());
        value.unwrap_or_else(|| panic!("{series} is missing in\n{text}"))
    }

    /// Waits until nobody is left in the queue.
    pub async fn drained(&self) {
        let began = std::time::Instant::now();
        while self.metric("placeformer_queue_depth").await > 0.0 {
            assert!(began.elapsed() < PATIENCE, "the queue never emptied");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    pub async fn patch(&self, path: &str, body: &Value) -> Answer {
        let request = Request::patch(path).header("content-type", "application/json");
        self.send(request.body(Body::from(body.to_string())).unwrap())
            .await
    }

    /// References over all maps, as the listing shows them.
    pub async fn count(&self) -> usize {
        self.get("/references?limit=1000").await.json["references"]
            .as_array()
            .unwrap()
            .len()
    }
}

/// The state of a server and its service, not yet opened.
pub fn open(
    directory: &Path,
    source: Arc<dyn DescriptorSource>,
    config: Config,
) -> (AppState, Arc<Service>) {
    start(
        Arc::new(SqliteStore::open(directory, &config.store).unwrap()),
        source,
        config,
    )
}

fn start(
    store: Arc<dyn PlaceStore>,
    source: Arc<dyn DescriptorSource>,
    config: Config,
) -> (AppState, Arc<Service>) {
    let metrics = Arc::new(Metrics::new().unwrap());
    let health = Arc::new(Health::default());
    let limit = config.image.max_bytes;
    let state = AppState::new(
        config.http.clone(),
        &config.auth,
        limit,
        metrics.clone(),
        health.clone(),
    )
    .unwrap();
    let Config {
        image,
        rerank,
        pipeline,
        tracks,
        ..
    } = config;
    let service = Service::start(Parts {
        store,
        source,
        image,
        rerank,
        pipeline,
        tracks,
        track_key: TrackKey::new(&[7; KEY_BYTES]),
        metrics,
        health,
    })
    .unwrap();
    (state, service)
}

/// An answer read to its end.
#[derive(Debug)]
pub struct Answer {
    pub status: StatusCode,
    pub headers: HeaderMap,
    pub text: String,
    pub json: Value,
}

impl Answer {
    pub async fn of(response: Response) -> Self {
        let (parts, body) = response.into_parts();
        let bytes = body.collect().await.unwrap().to_bytes();
        let text = String::from_utf8_lossy(&bytes).into_owned();
        let json = serde_json::from_str(&text).unwrap_or_default();
        Self {
            status: parts.status,
            headers: parts.headers,
            text,
            json,
        }
    }

    pub fn header(&self, name: &str) -> &str {
        self.headers
            .get(name)
            .map_or("", |value| value.to_str().unwrap())
    }

    /// Checks that this is the problem `code`, whole and from the table, and returns its detail.
    #[track_caller]
    pub fn problem(&self, code: &str) -> &str {
        assert_eq!(self.json["code"], code, "{}", self.text);
        let row = placeformer_core::error::ErrorCode::ALL
            .iter()
            .find(|row| row.as_str() == code)
            .unwrap();
        assert_eq!(self.status.as_u16(), row.status());
        assert_eq!(self.json["status"], row.status());
        assert_eq!(self.json["title"], row.title());
        assert_eq!(self.json["retryable"], row.retryable());
        assert_eq!(self.header("content-type"), "application/problem+json");
        assert_eq!(self.json["request_id"], self.header("x-request-id"));
        assert_eq!(self.json["type"], format!("urn:placeformer:error:{code}"));
        match row.retry_after() {
            Some(_) => assert!(self.header("retry-after").parse::<u64>().unwrap() >= 1),
            None => assert_eq!(self.header("retry-after"), "", "{code}"),
        }
        self.json["detail"].as_str().unwrap()
    }

    #[track_caller]
    pub fn ok(&self) -> &Value {
        assert_eq!(self.status, StatusCode::OK, "{}", self.text);
        &self.json
    }

    #[track_caller]
    pub fn created(&self) -> &Value {
        assert_eq!(self.status, StatusCode::CREATED, "{}", self.text);
        &self.json
    }
}

/// A PNG that no other seed gives.
pub fn picture(seed: u64) -> Vec<u8> {
    noise::png(seed, SIZE.width / 4, SIZE.height / 4)
}

/// A multipart body of named parts, with its content type.
pub fn multipart(parts: &[(&str, &[u8])]) -> (String, Vec<u8>) {
    let boundary = "b0undary-of-the-test";
    let mut body = Vec::new();
    for (name, content) in parts {
        let head = format!(
            "--{boundary}\r\ncontent-disposition: form-data; name=\"{name}\"; filename=\"f\"\r\n\r\n"
        );
        body.extend_from_slice(head.as_bytes());
        body.extend_from_slice(content);
        body.extend_from_slice(b"\r\n");
    }
    body.extend_from_slice(format!("--{boundary}--\r\n").as_bytes());
    (format!("multipart/form-data; boundary={boundary}"), body)
}
