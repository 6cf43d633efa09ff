//! What every key means: the comments of the printed configuration.

/// The head of the printed file.
pub(super) const INTRODUCTION: &str = "\
# PlaceFormer's settings as they are in force. Every key may be left out.
# Each can also be set in the environment: PLACEFORMER_HTTP__LISTEN is `listen` of [http].
# Flags win over the environment, the environment over this file, this file over the defaults.
";

type Keys = &'static [(&'static str, &'static str)];

/// Keys of a section with their explanations.
pub(super) fn section(name: &str) -> Keys {
    SECTIONS
        .iter()
        .find(|(section, _)| *section == name)
        .map_or(&[], |(_, keys)| keys)
}

/// All sections.
pub(super) const SECTIONS: &[(&str, Keys)] = &[
    (
        "data",
        &[(
            "directory",
            "Directory of the store; made if it is not there. One process at a time.",
        )],
    ),
    (
        "store",
        &[
            (
                "readers",
                "Most reading connections open at once; further readers wait.",
            ),
            (
                "cache_kib",
                "Page cache of each connection; patches come through the system's cache.",
            ),
            (
                "page_bytes",
                "Size of a database page, a power of two from 4096 to 65536; fixed at creation.",
            ),
            (
                "log_bytes",
                "Size of the write-ahead log at which it is folded into the database.",
            ),
            (
                "reserve_bytes",
                "Room kept so that deletes succeed on a full disk (at most a quarter of what is left).",
            ),
            (
                "queue",
                "Writes that may wait for the writer; further ones block their caller.",
            ),
        ],
    ),
    (
        "http",
        &[
            ("listen", "Address and port; port 0 picks a free one."),
            (
                "max_connections",
                "Connections open at once; further ones wait in the kernel's backlog.",
            ),
            (
                "header_timeout_ms",
                "Time for a request's head to arrive, also between two requests of one connection.",
            ),
            ("body_timeout_ms", "Time for a whole body to arrive."),
            ("body_idle_timeout_ms", "Longest pause within a body."),
            ("max_header_bytes", "Largest head of a request."),
            (
                "max_buffered_bytes",
                "Bytes of bodies held at once over all requests; beyond: 503 overloaded.",
            ),
            ("max_page", "Most references in one page of a listing."),
            (
                "drain_delay_ms",
                "After SIGTERM: time between failing /readyz and refusing connections.",
            ),
            (
                "drain_timeout_ms",
                "After SIGTERM: time for requests under way to finish.",
            ),
        ],
    ),
    (
        "auth",
        &[
            (
                "keys",
                "Accepted API keys; none: the service is open. Each has a name, the SHA-256 of the key\n\
                 (printf %s KEY | sha256sum), a role (\"read\" or \"write\") and, if it differs, its own\n\
                 requests_per_second.",
            ),
            ("protect_metrics", "Whether /metrics needs a key, too."),
            (
                "requests_per_second",
                "Pace of one key (of one address without keys); 0: unbounded.",
            ),
            (
                "burst",
                "Requests that may come at once beyond that pace; 0: as many as a second's.",
            ),
        ],
    ),
    (
        "pipeline",
        &[
            (
                "queue_capacity",
                "Queries, and beside them references, waiting or in compute; beyond: 503 overloaded.",
            ),
            (
                "max_wait_ms",
                "Longest wait of a query for its turn; one that would wait longer gets 503 at once.",
            ),
            (
                "store_reads",
                "Listings and look-ups at the store at once, at least two fewer than store.readers: those are\n\
                 left to queries and changes. Without a turn within max_wait_ms: 503 overloaded.",
            ),
            (
                "store_writes",
                "Changes and deletions under way at once, with the same wait.",
            ),
            (
                "patch_cache_bytes",
                "Key patches kept in memory for the next query.",
            ),
            ("top_k", "Results of a query that does not say."),
            (
                "candidates",
                "Candidates re-ranked for a query that does not say.",
            ),
            (
                "max_candidates",
                "Most results or candidates a query may ask for.",
            ),
            (
                "deadline_ms",
                "Time for a query that does not say, and the most it may ask for.",
            ),
            (
                "answer_reserve_ms",
                "Part of a query's time kept back for writing the answer.",
            ),
            (
                "memory_watermark_bytes",
                "Resident bytes above which nothing new is taken in; 0: 85% of what the process may use.",
            ),
            (
                "disk_reserve_bytes",
                "Free bytes on the store's disk below which nothing new is taken in, so that deletions\n\
                 have room; at most a twentieth of the disk.",
            ),
            (
                "max_metadata_bytes",
                "Longest metadata of a reference, as JSON.",
            ),
        ],
    ),
    (
        "image",
        &[
            ("max_bytes", "Largest image in bytes."),
            ("max_side", "Longest side in pixels."),
            ("max_pixels", "Most pixels."),
        ],
    ),
    (
        "extract",
        &[
            (
                "preset",
                "The backbone: dinov2-vits14, dinov2-vitb14, dinov2-vitl14 or placeformer-vits16.",
            ),
            (
                "weights",
                "Weights file of your own for that backbone (safetensors by timm, DINO or Hugging Face names, or what\n\
                 `train` wrote); the published ones, pulled on first use, unless set.",
            ),
            (
                "input_size",
                "Images are squashed to this, each side a multiple of the patch size; the preset's own.",
            ),
            (
                "exit_block",
                "0-based block whose tokens are used; later ones are not computed; the preset's own.",
            ),
            (
                "token_norm",
                "Whether the tokens pass the final LayerNorm; the preset's own.",
            ),
            (
                "attention_block",
                "0-based block whose CLS attention ranks patches; the exit block.",
            ),
            (
                "heads",
                "Attention heads, for weights trained with another count than the preset's.",
            ),
            (
                "tau",
                "Key patches must exceed this multiple of the uniform attention; 1 is the paper's 0.01.",
            ),
            ("caps", "Most key patches at scales 1, 2 and 3."),
            (
                "stride",
                "Distance between fused windows: \"kernel\" (no overlap) or \"one\" (every patch).",
            ),
            (
                "head",
                "Projection to the global descriptor: \"default\" (the one built in for the backbone and its published\n\
                 weights) or a file, as `head fit`, `head train` or `train` wrote it. \"none\" is for evaluation only.",
            ),
            (
                "precision",
                "Arithmetic of the transformer: f32, bf16, int8, mixed (int8 in the blocks where it shows least, bf16 in the\n\
                 others), or auto (mixed where the CPU has AVX-512 VNNI, else f32).",
            ),
        ],
    ),
    (
        "rerank",
        &[
            (
                "scales",
                "Scale combinations whose inliers add up to S; the paper's best row is 1, 1+2, 2+3.",
            ),
            ("tolerance_patches", "Inlier tolerance in base patches."),
            (
                "max_iterations",
                "Most homographies tried for one combination.",
            ),
            (
                "confidence",
                "Probability of having seen the best homography at which the search stops.",
            ),
        ],
    ),
    (
        "log",
        &[
            ("format", "\"human\" or \"json\" (one object a line)."),
            (
                "filter",
                "What is logged: \"info\", \"placeformer=debug\", ...",
            ),
        ],
    ),
];
