//! Everything the service measures, in Prometheus' terms.
//!
//! Every series is registered and set to zero at start, so that an alert on a rate works from the
//! first minute. Labels are bounded: routes are matched paths, and maps beyond the largest fifty
//! are added up as `other`.

mod labels;

pub use labels::{
    ConnectionCut, ConnectionKind, ImageUse, MemoryComponent, PipelineStage, Rejection,
};

use super::logging;
use placeformer_core::types::MapName;
use prometheus::core::Collector;
use prometheus::process_collector::ProcessCollector;
use prometheus::proto::MetricFamily;
use prometheus::{
    Encoder, Error, Histogram, HistogramOpts, HistogramVec, IntCounter, IntCounterVec, IntGauge,
    IntGaugeVec, Opts, Registry, TextEncoder,
};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Upper bounds in seconds, 1 ms to 10 s.
const SECONDS: [f64; 16] = [
    0.001, 0.002, 0.004, 0.008, 0.015, 0.025, 0.04, 0.06, 0.1, 0.2, 0.4, 0.8, 1.5, 3.0, 6.0, 10.0,
];

/// Upper bounds of the spatial score S.
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

/// Label of the maps that have no series of their own.
const OTHER_MAPS: &str = "other";

/// All series. Cheap to share behind an `Arc`; every method is safe from any thread.
pub struct Metrics {
    registry: Registry,
    requests: RequestSeries,
    stage_seconds: HistogramVec,
    queue_depth: IntGauge,
    rejected: IntCounterVec,
    /// References of each map. Their series are made when they are read, because not everyone may
    /// see every name.
    references: Mutex<Vec<(MapName, u64)>>,
    descriptor_bytes: HistogramVec,
    memory_bytes: IntGaugeVec,
    queries: QuerySeries,
    corrupt_records: IntCounter,
    quarantined: IntGauge,
    ready: IntGauge,
    disk_free_bytes: IntGauge,
    cache_lookups: IntCounterVec,
    uninformative_images: IntCounterVec,
    lost_log_lines: LostLogLines,
    connections: ConnectionSeries,
}

impl Metrics {
    /// Registers every series.
    ///
    /// # Errors
    /// Two series share a name.
    pub fn new() -> Result<Self, Error> {
        let series = Series(Registry::new());
        series.add(ProcessCollector::for_self())?;
        series
            .gauges("build_info", "Always 1.", &["version"])?
            .with_label_values(&[env!("CARGO_PKG_VERSION")])
            .set(1);
        let metrics = Self {
            requests: RequestSeries::new(&series)?,
            stage_seconds: series.histograms(
                "stage_duration_seconds",
                "Time in a stage.",
                &["stage"],
                &SECONDS,
            )?,
            queue_depth: series.gauge("queue_depth", "Requests waiting for or in compute.")?,
            rejected: series.counters("rejected_total", "Work turned away.", &["reason"])?,
            references: Mutex::default(),
            descriptor_bytes: series.histograms(
                "descriptor_bytes",
                "Size of a stored descriptor.",
                &["kind"],
                &BYTES,
            )?,
            memory_bytes: series.gauges("memory_bytes", "Memory by component.", &["component"])?,
            queries: QuerySeries::new(&series)?,
            corrupt_records: series.counter(
                "corrupt_records_total",
                "Damaged records found, at start or by any request.",
            )?,
            quarantined: series.gauge(
                "quarantined_references",
                "Damaged references set aside, not served.",
            )?,
            ready: series.gauge(
                "ready",
                "1 if queries are answered (/readyz?for=query), else 0.",
            )?,
            disk_free_bytes: series.gauge("disk_free_bytes", "Free bytes on the store's disk.")?,
            cache_lookups: series.counters(
                "patch_cache_lookups_total",
                "Key patches asked of the cache.",
                &["result"],
            )?,
            uninformative_images: series.counters(
                "uninformative_images_total",
                "Images that show nothing to know a place by.",
                &["kind"],
            )?,
            lost_log_lines: LostLogLines::new(&series)?,
            connections: ConnectionSeries::new(&series)?,
            registry: series.0,
        };
        metrics.start_at_zero();
        Ok(metrics)
    }

    fn start_at_zero(&self) {
        for stage in PipelineStage::ALL {
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
        for kind in ImageUse::ALL {
            self.uninformative_images
                .with_label_values(&[kind.as_str()]);
        }
        for kind in ConnectionKind::ALL {
            self.set_connections(kind, 0);
        }
        for reason in ConnectionCut::ALL {
            self.connections.cut.with_label_values(&[reason.as_str()]);
        }
    }

    /// Makes the series of a route appear with zeros, one for each status it documents.
    pub fn expect_route(&self, route: &str, method: &str, statuses: impl IntoIterator<Item = u16>) {
        self.requests.seconds.with_label_values(&[route]);
        for status in statuses {
            self.requests
                .answered
                .with_label_values(&[route, method, &status.to_string()]);
        }
    }

    /// One request was answered.
    pub fn request(&self, route: &str, method: &str, status: u16, took: Duration) {
        self.requests
            .answered
            .with_label_values(&[route, method, &status.to_string()])
            .inc();
        self.requests
            .seconds
            .with_label_values(&[route])
            .observe(took.as_secs_f64());
    }

    /// A stage took this long.
    pub fn stage(&self, stage: PipelineStage, took: Duration) {
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

    /// A request left them.
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

    /// A query was answered. `top1_score` is the S of its best result: 0 without any result, `None`
    /// if it was not re-ranked. `matched` says whether that result is trusted: `None` without a
    /// calibration.
    pub fn query_answered(&self, top1_score: Option<u32>, matched: Option<bool>) {
        if let Some(score) = top1_score {
            self.queries.top1_score.observe(f64::from(score));
        }
        if matched == Some(false) {
            self.queries.unmatched.inc();
        }
    }

    /// An image was measured that shows nothing by which a place could be known.
    pub fn uninformative_image(&self, kind: ImageUse) {
        let series = &self.uninformative_images;
        series.with_label_values(&[kind.as_str()]).inc();
    }

    /// A vehicle whose place was known is at no known place any more.
    pub fn track_lost(&self) {
        self.queries.tracks_lost.inc();
    }

    /// So many damaged records were found that had not been found before.
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

    /// The patch cache was asked for the key patches of a reference.
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

    /// References of each map.
    pub fn set_references(&self, maps: Vec<(MapName, u64)>) {
        *self.lock_references() = maps;
    }

    /// Connections that are open.
    pub fn set_connections(&self, kind: ConnectionKind, open: usize) {
        let open = i64::try_from(open).unwrap_or(i64::MAX);
        let series = self.connections.open.with_label_values(&[kind.as_str()]);
        series.set(open);
    }

    /// A connection was ended, or not taken.
    pub fn connection_cut(&self, reason: ConnectionCut) {
        let series = self.connections.cut.with_label_values(&[reason.as_str()]);
        series.inc();
    }

    /// All series in Prometheus' text format. Of the maps that `is_shown` lets through, the largest
    /// [`MAPS_SHOWN`] have their name; all others are added up.
    ///
    /// # Errors
    /// A series cannot be written as text.
    pub fn render(&self, is_shown: impl Fn(&MapName) -> bool) -> Result<String, Error> {
        TextEncoder::new().encode_to_string(&self.families(is_shown)?)
    }

    fn families(&self, is_shown: impl Fn(&MapName) -> bool) -> Result<Vec<MetricFamily>, Error> {
        self.lost_log_lines.follow(logging::lost_lines());
        let mut families = self.registry.gather();
        families.extend(self.reference_series(is_shown)?);
        Ok(families)
    }

    fn reference_series(
        &self,
        is_shown: impl Fn(&MapName) -> bool,
    ) -> Result<Vec<MetricFamily>, Error> {
        // A registry of its own puts them in the order of the others: that of their labels.
        let series = Series(Registry::new());
        let gauges = series.gauges("references", "References that can be found.", &["map"])?;
        let maps = self.lock_references();
        let (mut shown, hidden): (Vec<_>, Vec<_>) = maps.iter().partition(|(map, _)| is_shown(map));
        shown.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        let rest = shown.split_off(shown.len().min(MAPS_SHOWN));
        for (map, count) in shown {
            gauges.with_label_values(&[map.as_str()]).set(*count as i64);
        }
        let other: u64 = rest.iter().chain(&hidden).map(|(_, count)| count).sum();
        // Added, because a map may have that name, too.
        gauges.with_label_values(&[OTHER_MAPS]).add(other as i64);
        Ok(series.0.gather())
    }

    // A thread that panics with the lock leaves the list whole, because it is replaced by one
    // assignment. So a poisoned lock can be used all the same.
    fn lock_references(&self) -> MutexGuard<'_, Vec<(MapName, u64)>> {
        self.references
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes what [`Metrics::render`] returns.
    ///
    /// # Errors
    /// A series cannot be written as text, or `writer` takes no more.
    pub fn render_to(
        &self,
        is_shown: impl Fn(&MapName) -> bool,
        writer: &mut impl std::io::Write,
    ) -> Result<(), Error> {
        TextEncoder::new().encode(&self.families(is_shown)?, writer)
    }

    /// Content type of [`Metrics::render`].
    pub fn content_type() -> String {
        TextEncoder::new().format_type().to_owned()
    }
}

/// What became of HTTP requests.
struct RequestSeries {
    answered: IntCounterVec,
    seconds: HistogramVec,
}

impl RequestSeries {
    fn new(series: &Series) -> Result<Self, Error> {
        Ok(Self {
            answered: series.counters(
                "http_requests_total",
                "Requests answered.",
                &["route", "method", "status"],
            )?,
            seconds: series.histograms(
                "http_request_duration_seconds",
                "Time to an answer.",
                &["route"],
                &SECONDS,
            )?,
        })
    }
}

/// How good the answers of queries are.
struct QuerySeries {
    top1_score: Histogram,
    unmatched: IntCounter,
    tracks_lost: IntCounter,
}

impl QuerySeries {
    fn new(series: &Series) -> Result<Self, Error> {
        Ok(Self {
            top1_score: series.histogram(
                "query_top1_score",
                "S of the best answer after re-ranking.",
                &SCORES,
            )?,
            unmatched: series.counter(
                "query_unmatched_total",
                "Queries whose best answer is not trusted.",
            )?,
            tracks_lost: series.counter(
                "tracks_lost_total",
                "Tracks that came from a known place to none.",
            )?,
        })
    }
}

/// Log lines that were lost in this process, which counts them before there are any metrics.
struct LostLogLines {
    counter: IntCounter,
    counted: AtomicU64,
}

impl LostLogLines {
    fn new(series: &Series) -> Result<Self, Error> {
        Ok(Self {
            counter: series.counter(
                "log_lines_dropped_total",
                "Log lines that nobody took: standard error was full, closed or not read.",
            )?,
            counted: AtomicU64::new(0),
        })
    }

    /// Brings the counter to `lost`, which never falls; safe from several threads at once.
    fn follow(&self, lost: u64) {
        let counted = self.counted.fetch_max(lost, Ordering::Relaxed);
        self.counter.inc_by(lost.saturating_sub(counted));
    }
}

/// Who is connected.
struct ConnectionSeries {
    open: IntGaugeVec,
    cut: IntCounterVec,
}

impl ConnectionSeries {
    fn new(series: &Series) -> Result<Self, Error> {
        Ok(Self {
            open: series.gauges("connections", "Connections that are open.", &["kind"])?,
            cut: series.counters(
                "connections_cut_total",
                "Connections that the server ended, or did not take.",
                &["reason"],
            )?,
        })
    }
}

/// Makes series and registers them. Names are given without the prefix of the service.
struct Series(Registry);

impl Series {
    fn add<C: Collector + 'static>(&self, collector: C) -> Result<(), Error> {
        self.0.register(Box::new(collector))
    }

    fn counter(&self, name: &str, help: &str) -> Result<IntCounter, Error> {
        let counter = IntCounter::with_opts(options(name, help))?;
        self.add(counter.clone())?;
        Ok(counter)
    }

    fn counters(&self, name: &str, help: &str, labels: &[&str]) -> Result<IntCounterVec, Error> {
        let counters = IntCounterVec::new(options(name, help), labels)?;
        self.add(counters.clone())?;
        Ok(counters)
    }

    fn gauge(&self, name: &str, help: &str) -> Result<IntGauge, Error> {
        let gauge = IntGauge::with_opts(options(name, help))?;
        self.add(gauge.clone())?;
        Ok(gauge)
    }

    fn gauges(&self, name: &str, help: &str, labels: &[&str]) -> Result<IntGaugeVec, Error> {
        let gauges = IntGaugeVec::new(options(name, help), labels)?;
        self.add(gauges.clone())?;
        Ok(gauges)
    }

    fn histogram(&self, name: &str, help: &str, bounds: &[f64]) -> Result<Histogram, Error> {
        let options = HistogramOpts::from(options(name, help)).buckets(bounds.to_vec());
        let histogram = Histogram::with_opts(options)?;
        self.add(histogram.clone())?;
        Ok(histogram)
    }

    fn histograms(
        &self,
        name: &str,
        help: &str,
        labels: &[&str],
        bounds: &[f64],
    ) -> Result<HistogramVec, Error> {
        let options = HistogramOpts::from(options(name, help)).buckets(bounds.to_vec());
        let histograms = HistogramVec::new(options, labels)?;
        self.add(histograms.clone())?;
        Ok(histograms)
    }
}

fn options(name: &str, help: &str) -> Opts {
    Opts::new(format!("placeformer_{name}"), help)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_series_of_the_design_is_there_from_the_start() {
        let text = Metrics::new().unwrap().render(|_| true).unwrap();
        for series in [
            "placeformer_stage_duration_seconds_count{stage=\"commit\"} 0",
            "placeformer_rejected_total{reason=\"queue_full\"} 0",
            "placeformer_memory_bytes{component=\"index\"} 0",
            "placeformer_descriptor_bytes_count{kind=\"patches\"} 0",
            "placeformer_queue_depth 0",
            "placeformer_query_top1_score_count 0",
            "placeformer_query_unmatched_total 0",
            "placeformer_uninformative_images_total{kind=\"query\"} 0",
            "placeformer_tracks_lost_total 0",
            "placeformer_log_lines_dropped_total 0",
            "placeformer_rejected_total{reason=\"storage_lost\"} 0",
            "placeformer_build_info{version=",
            "process_resident_memory_bytes",
        ] {
            assert!(text.contains(series), "{series} is missing in\n{text}");
        }
    }

    fn sixty_maps() -> Vec<(MapName, u64)> {
        let map = |i: u64| (format!("map{i:02}").parse().unwrap(), 100 - i);
        (0..60).map(map).collect()
    }

    #[test]
    fn maps_that_are_not_shown_are_added_up() {
        let metrics = Metrics::new().unwrap();
        let series = |is_shown: fn(&MapName) -> bool| {
            let text = metrics.render(is_shown).unwrap();
            let lines = text
                .lines()
                .filter(|line| line.starts_with("placeformer_references{"));
            lines.map(str::to_owned).collect::<Vec<_>>()
        };
        assert_eq!(
            series(|_| true),
            ["placeformer_references{map=\"other\"} 0"]
        );
        metrics.set_references(sixty_maps());
        let all: u64 = (0..60).map(|i| 100 - i).sum();
        let other = format!("placeformer_references{{map=\"other\"}} {all}");
        assert_eq!(series(|_| false), [other]);
        let other = format!("placeformer_references{{map=\"other\"}} {}", all - 88);
        let own = "placeformer_references{map=\"map12\"} 88".to_owned();
        assert_eq!(series(|map| map.as_str() == "map12"), [own, other]);
    }

    #[test]
    fn maps_beyond_fifty_fold_into_other() {
        let metrics = Metrics::new().unwrap();
        metrics.set_references(sixty_maps());
        let text = metrics.render(|_| true).unwrap();
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
