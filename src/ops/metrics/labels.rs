//! The values that labels of the series can have.

/// A stage of the pipeline, as a label and in the timings of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum PipelineStage {
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
    /// What a track expects, and what is believed of it after the photo.
    Track,
    /// Writing to the store, until it is durable.
    Commit,
}

impl PipelineStage {
    /// All stages in the order of the data.
    pub const ALL: [Self; 8] = [
        Self::Decode,
        Self::Queue,
        Self::Extract,
        Self::Search,
        Self::Load,
        Self::Rerank,
        Self::Track,
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
            Self::Track => "track",
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
    /// The files of the store are gone, exchanged, or cannot be written.
    StorageLost,
    /// Too many bytes of answers wait for their clients.
    AnswerMemory,
    /// All connections but those for probes are taken.
    Connections,
    /// Its address presented too many keys that are not known.
    FailedKeys,
}

impl Rejection {
    /// All reasons.
    pub const ALL: [Self; 14] = [
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
        Self::StorageLost,
        Self::AnswerMemory,
        Self::Connections,
        Self::FailedKeys,
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
            Self::StorageLost => "storage_lost",
            Self::NotReady => "not_ready",
            Self::Draining => "draining",
            Self::Deadline => "deadline",
            Self::ClientGone => "client_gone",
            Self::AnswerMemory => "answer_memory",
            Self::Connections => "connections",
            Self::FailedKeys => "failed_keys",
        }
    }
}

/// A component whose memory is known; the values of `memory_bytes{component}`.
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
    pub(super) const ALL: [Self; 4] = [Self::Model, Self::Index, Self::Cache, Self::Sqlite];

    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Model => "model",
            Self::Index => "index",
            Self::Cache => "cache",
            Self::Sqlite => "sqlite",
        }
    }
}

/// What a connection may be used for; the values of `connections{kind}`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ConnectionKind {
    /// Everything.
    General,
    /// Probes only.
    Reserved,
}

impl ConnectionKind {
    pub(super) const ALL: [Self; 2] = [Self::General, Self::Reserved];

    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::General => "general",
            Self::Reserved => "reserved",
        }
    }
}

/// Why the server ended a connection, or did not take it; the values of
/// `connections_cut_total{reason}`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ConnectionCut {
    /// It was idle, and a new client needed its place.
    Evicted,
    /// It had sent nothing while connections were scarce.
    Silent,
    /// There was no place for it.
    Refused,
    /// Its client took an answer too slowly.
    SlowReader,
    /// Its TLS handshake failed or took too long.
    Handshake,
}

impl ConnectionCut {
    pub(super) const ALL: [Self; 5] = [
        Self::Evicted,
        Self::Silent,
        Self::Refused,
        Self::SlowReader,
        Self::Handshake,
    ];

    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Evicted => "evicted",
            Self::Silent => "silent",
            Self::Refused => "refused",
            Self::SlowReader => "slow_reader",
            Self::Handshake => "handshake",
        }
    }
}

/// What an image is for; the values of `uninformative_images_total{kind}`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageUse {
    /// A place is looked for, or two images are matched.
    Query,
    /// It is to be stored.
    Reference,
}

impl ImageUse {
    /// All uses.
    pub const ALL: [Self; 2] = [Self::Query, Self::Reference];

    /// Its label.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Query => "query",
            Self::Reference => "reference",
        }
    }
}
