//! What the rows are called.

/// The rows there are, in the order they are measured. `search_10m` takes 14 GB and runs only when
/// it is named.
pub const NAMES: [&str; 20] = [
    "decode_resize_1080p",
    "extract",
    "extract_batch8",
    "extract_f32",
    "extract_bf16",
    "extract_mixed",
    "extract_int8",
    "load_100",
    "rerank_100",
    "rerank_100_at_15",
    "rerank_100_at_0",
    "search_10k",
    "search_100k",
    "search_1m",
    "search_10m",
    "track_1m",
    "query_1m",
    "commit",
    "ingest",
    "rehead_100k",
];
