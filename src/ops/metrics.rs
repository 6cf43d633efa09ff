//! Everything the service measures, in Prometheus' terms.
//!
//! Every series is registered and set to zero at start, so that an alert on a rate works from the
//! first minute. Labels are bounded: routes are matched paths, maps beyond the first fifty fold
//! into `other`.

use prometheus::{
    Encoder, Histogram, HistogramOpts, HistogramVec, IntCounter, IntCounterVec, IntGauge,
    IntGaugeVec, Opts, Registry, TextEncoder,
};
use std::time::Duration;

/// A stage of the pipeline, as a label and in the timings of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Stage {
    /// Bytes to a tensor.
    Decode,
    /// Waiting for the compute worker.
    Queue,
    /// Tensor to descriptor.
    Extract,
    /// Global nearest neighbours.
    Search,
    /// Candidates' key patches from the store.
    Load,
    /// Matching and verification.
    Rerank,
    /// Writing to the store, until it is durable.
    Commit,
}

impl Stage {
    /// All stages in the order of the data.
    pub const ALL: [Self; 7] = [
        Self::Decode,
        Self::Queue,
        Self::Extract,
        Self::Search,
        Self::Load,
        Self::Rerank,
        Self::Commit,
    ];

    /// Its label.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Decode => "decode",
            Self::Queue => "queue",
            Self::Extract => "extract",
            Self::Search => "search",
            Self::Load => "load",
            Self::Rerank => "rerank",
            Self::Commit => "commit",
        }
    }
}

/// Why work was turned away; the values of `rejected_total{reason}`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rejection {
    /// The compute queue is full.
    QueueFull,
    /// Too many others read or change the store.
    StoreBusy,
    /// Too many bytes of bodies are being received.
    BodyMemory,
    /// The key's rate is used up.
    RateLimited,
    /// Resident memory is above the watermark.
    MemoryPressure,
    /// No room to store it.
    DiskFull,
    /// Still starting.
    NotReady,
    /// Stopping.
    Draining,
    /// Its deadline passed.
    Deadline,
    /// Its client left.
    ClientGone,
}

impl Rejection {
    /// All reasons.
    pub const ALL: [Self; 10] = [
        Self::QueueFull,
        Self::StoreBusy,
        Self::BodyMemory,
        Self::RateLimited,
        Self::MemoryPressure,
        Self::DiskFull,
        Self::NotReady,
        Self::Draining,
        Self::Deadline,
        Self::ClientGone,
    ];

    /// Its label.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::QueueFull => "queue_full",
            Self::StoreBusy => "store_busy",
            Self::BodyMemory => "body_memory",
            Self::RateLimited => "rate_limited",
            Self::MemoryPressure => "memory_pressure",
            Self::DiskFull => "disk_full",
            Self::NotReady => "not_ready",
            Self::Draining => "draining",
            Self::Deadline => "deadline",
            Self::ClientGone => "client_gone",
        }
    }
}

/// A component whose memory is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MemoryComponent {
    /// Weights.
    Model,
    /// Global descriptors of all maps.
    Index,
    /// Key patches kept for the next query.
    Cache,
    /// The database engine's own caches.
    Sqlite,
}

impl MemoryComponent {
    const ALL: [Self; 4] = [Self::Model, Self::Index, Self::Cache, Self::Sqlite];

    fn as_str(self) -> &'static str {
        match self {
            Self::Model => "model",
            Self::Index => "index",
            Self::Cache => "cache",
            Self::Sqlite => "sqlite",
        }
    }
}

/// Upper bounds in seconds, 1 ms to 10 s.
const SECONDS: [f64; 16] = [
    0.001, 0.002, 0.004, 0.008, 0.015, 0.025, 0.04, 0.06, 0.1, 0.2, 0.4, 0.8, 1.5, 3.0, 6.0, 10.0,
];
/// Upper bounds of S.
const SCORES: [f64; 14] = [
    0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 120.0, 200.0, 300.0, 500.0, 800.0,
];
/// Upper bounds in bytes, 1 KiB to 1 MiB.
const BYTES: [f64; 11] = [
    1024.0,
    2048.0,
    4096.0,
    8192.0,
    16384.0,
    32768.0,
    65536.0,
    131_072.0,
    262_144.0,
    524_288.0,
    1_048_576.0,
];
/// Maps with a series of their own.
const MAPS_SHOWN: usize = 50;

/// All series. Cheap to share behind an `Arc`; every method is safe from any thread.
pub struct Metrics {
    registry: Registry,
    requests: IntCounterVec,
    request_seconds: HistogramVec,
    stage_seconds: HistogramVec,
    queue_depth: IntGauge,
    rejected: IntCounterVec,
    references: IntGaugeVec,
    descriptor_bytes: HistogramVec,
    memory_bytes: IntGaugeVec,
    top1_score: Histogram,
    unmatched: IntCounter,
    corrupt_records: IntCounter,
    quarantined: IntGauge,
    ready: IntGauge,
    disk_free_bytes: IntGauge,
    cache_lookups: IntCounterVec,
}

impl Metrics {
    /// Registers every series. Fails only if two share a name.
    pub fn new() -> Result<Self, prometheus::Error> {
        let counter = |name: &str, help: &str, labels: &[&str]| {
            IntCounterVec::new(Opts::new(full(name), help), labels)
        };
        let gauge = |name: &str, help: &str, labels: &[&str]| {
            IntGaugeVec::new(Opts::new(full(name), help), labels)
        };
        let metrics = Self {
            registry: Registry::new(),
            requests: counter(
                "http_requests_total",
                "Requests answered.",
                &["route", "method", "status"],
            )?,
            request_seconds: histogram(
                "http_request_duration_seconds",
                "Time to an answer.",
                &["route"],
                &SECONDS,
            )?,
            stage_seconds: histogram(
                "stage_duration_seconds",
                "Time in a stage.",
                &["stage"],
                &SECONDS,
            )?,
            queue_depth: IntGauge::new(full("queue_depth"), "Requests waiting for or in compute.")?,
            rejected: counter("rejected_total", "Work turned away.", &["reason"])?,
            references: gauge("references", "References that can be found.", &["map"])?,
            descriptor_bytes: histogram(
                "descriptor_bytes",
                "Size of a stored descriptor.",
                &["kind"],
                &BYTES,
            )?,
            memory_bytes: gauge("memory_bytes", "Memory by component.", &["component"])?,
            top1_score: Histogram::with_opts(
                HistogramOpts::new(
                    full("query_top1_score"),
                    "S of the best answer after re-ranking.",
                )
                .buckets(SCORES.to_vec()),
            )?,
            unmatched: IntCounter::new(
                full("query_unmatched_total"),
                "Queries whose best answer is not trusted.",
            )?,
            corrupt_records: IntCounter::new(
                full("corrupt_records_total"),
                "Damaged records met, at start or by any request.",
            )?,
            quarantined: IntGauge::new(
                full("quarantined_references"),
                "Damaged references set aside, not served.",
            )?,
            ready: IntGauge::new(
                full("ready"),
                "1 if queries are answered (/readyz?for=query), else 0.",
            )?,
            disk_free_bytes: IntGauge::new(
                full("disk_free_bytes"),
                "Free bytes on the store's disk.",
            )?,
            cache_lookups: counter(
                "patch_cache_lookups_total",
                "Key patches asked of the cache.",
                &["result"],
            )?,
        };
        metrics.register()?;
        metrics.start_at_zero();
        Ok(metrics)
    }

    fn register(&self) -> Result<(), prometheus::Error> {
        let build = IntGaugeVec::new(Opts::new(full("build_info"), "Always 1."), &["version"])?;
        build.with_label_values(&[env!("CARGO_PKG_VERSION")]).set(1);
        self.registry.register(Box::new(build))?;
        self.registry.register(Box::new(self.requests.clone()))?;
        self.registry
            .register(Box::new(self.request_seconds.clone()))?;
        self.registry
            .register(Box::new(self.stage_seconds.clone()))?;
        self.registry.register(Box::new(self.queue_depth.clone()))?;
        self.registry.register(Box::new(self.rejected.clone()))?;
        self.registry.register(Box::new(self.references.clone()))?;
        self.registry
            .register(Box::new(self.descriptor_bytes.clone()))?;
        self.registry
            .register(Box::new(self.memory_bytes.clone()))?;
        self.registry.register(Box::new(self.top1_score.clone()))?;
        self.registry.register(Box::new(self.unmatched.clone()))?;
        self.registry
            .register(Box::new(self.corrupt_records.clone()))?;
        self.registry.register(Box::new(self.quarantined.clone()))?;
        self.registry.register(Box::new(self.ready.clone()))?;
        self.registry
            .register(Box::new(self.disk_free_bytes.clone()))?;
        self.registry
            .register(Box::new(self.cache_lookups.clone()))?;
        self.registry.register(Box::new(
            prometheus::process_collector::ProcessCollector::for_self(),
        ))
    }

    fn start_at_zero(&self) {
        for stage in Stage::ALL {
            self.stage_seconds.with_label_values(&[stage.as_str()]);
        }
        for reason in Rejection::ALL {
            self.rejected.with_label_values(&[reason.as_str()]);
        }
        for component in MemoryComponent::ALL {
            self.memory_bytes.with_label_values(&[component.as_str()]);
        }
        for kind in ["global", "patches"] {
            self.descriptor_bytes.with_label_values(&[kind]);
        }
        for result in ["hit", "miss"] {
            self.cache_lookups.with_label_values(&[result]);
        }
        self.references.with_label_values(&["other"]);
    }

    /// Makes the series of a route appear with zeros, one for each status it documents.
    pub fn expect_route(&self, route: &str, method: &str, statuses: impl IntoIterator<Item = u16>) {
        self.request_seconds.with_label_values(&[route]);
        for status in statuses {
            self.requests
                .with_label_values(&[route, method, &status.to_string()]);
        }
    }

    /// One request was answered.
    pub fn request(&self, route: &str, method: &str, status: u16, took: Duration) {
        self.requests
            .with_label_values(&[route, method, &status.to_string()])
            .inc();
        self.request_seconds
            .with_label_values(&[route])
            .observe(took.as_secs_f64());
    }

    /// A stage took this long.
    pub fn stage(&self, stage: Stage, took: Duration) {
        self.stage_seconds
            .with_label_values(&[stage.as_str()])
            .observe(took.as_secs_f64());
    }

    /// Work was turned away.
    pub fn rejected(&self, reason: Rejection) {
        self.rejected.with_label_values(&[reason.as_str()]).inc();
    }

    /// A request joined those waiting for or in compute.
    pub fn queue_entered(&self) {
        self.queue_depth.inc();
    }

    /// It left them.
    pub fn queue_left(&self) {
        self.queue_depth.dec();
    }

    /// A reference was stored with descriptors of these sizes in bytes.
    pub fn stored_descriptor(&self, global: usize, patches: usize) {
        self.descriptor_bytes
            .with_label_values(&["global"])
            .observe(global as f64);
        self.descriptor_bytes
            .with_label_values(&["patches"])
            .observe(patches as f64);
    }

    /// A query's best S (0 without any answer, `None` if it was not re-ranked), and whether that
    /// answer is trusted (`None` if nobody can say).
    pub fn query_answered(&self, top1_score: Option<u32>, matched: Option<bool>) {
        if let Some(score) = top1_score {
            self.top1_score.observe(f64::from(score));
        }
        if matched == Some(false) {
            self.unmatched.inc();
        }
    }

    /// So many damaged records were met for the first time.
    pub fn corrupt_records(&self, records: u64) {
        self.corrupt_records.inc_by(records);
    }

    /// Damaged references that are set aside until they are sent again or deleted.
    pub fn set_quarantined(&self, references: usize) {
        self.quarantined.set(references as i64);
    }

    /// Whether queries are answered.
    pub fn set_ready(&self, ready: bool) {
        self.ready.set(i64::from(ready));
    }

    /// Free bytes on the disk that holds the store.
    pub fn set_disk_free(&self, bytes: u64) {
        self.disk_free_bytes
            .set(i64::try_from(bytes).unwrap_or(i64::MAX));
    }

    /// The patch cache was asked.
    pub fn cache_lookup(&self, hit: bool) {
        self.cache_lookups
            .with_label_values(&[if hit { "hit" } else { "miss" }])
            .inc();
    }

    /// Memory of a component in bytes.
    pub fn set_memory(&self, component: MemoryComponent, bytes: u64) {
        self.memory_bytes
            .with_label_values(&[component.as_str()])
            .set(bytes as i64);
    }

    /// References per map; the largest [`MAPS_SHOWN`] keep their name.
    pub fn set_references(&self, mut maps: Vec<(String, u64)>) {
        maps.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        let rest = maps.split_off(maps.len().min(MAPS_SHOWN));
        self.references.reset();
        for (map, count) in &maps {
            self.references.with_label_values(&[map]).set(*count as i64);
        }
        let other: u64 = rest.iter().map(|(_, count)| count).sum();
        self.references
            .with_label_values(&["other"])
            .add(other as i64);
    }

    /// The exposition text.
    pub fn render(&self) -> Result<String, prometheus::Error> {
        TextEncoder::new().encode_to_string(&self.registry.gather())
    }

    /// Content type of [`Metrics::render`].
    pub fn content_type() -> String {
        TextEncoder::new().format_type().to_owned()
    }
}

fn full(name: &str) -> String {
    format!("placeformer_{name}")
}

fn histogram(
    name: &str,
    help: &str,
    labels: &[&str],
    bounds: &[f64],
) -> Result<HistogramVec, prometheus::Error> {
    HistogramVec::new(
        HistogramOpts::new(full(name), help).buckets(bounds.to_vec()),
        labels,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_series_of_the_design_is_there_from_the_start() {
        let text = Metrics::new().unwrap().render().unwrap();
        for series in [
            "placeformer_stage_duration_seconds_count{stage=\"commit\"} 0",
            "placeformer_rejected_total{reason=\"queue_full\"} 0",
            "placeformer_memory_bytes{component=\"index\"} 0",
            "placeformer_descriptor_bytes_count{kind=\"patches\"} 0",
            "placeformer_queue_depth 0",
            "placeformer_query_top1_score_count 0",
            "placeformer_query_unmatched_total 0",
            "placeformer_build_info{version=",
            "process_resident_memory_bytes",
        ] {
            assert!(text.contains(series), "{series} is missing in\n{text}");
        }
    }

    #[test]
    fn maps_beyond_fifty_fold_into_other() {
        let metrics = Metrics::new().unwrap();
        metrics.set_references((0..60).map(|i| (format!("map{i:02}"), 100 - i)).collect());
        let text = metrics.render().unwrap();
        assert_eq!(
            text.lines()
                .filter(|line| line.starts_with("placeformer_references{"))
                .count(),
            51
        );
        let folded: u64 = (50..60).map(|i| 100 - i).sum();
        assert!(text.contains(&format!("placeformer_references{{map=\"other\"}} {folded}")));
    }
}
