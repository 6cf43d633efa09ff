//! Best answers with what is known about them, and with the confidence given to them.

/// A query's best answer with what is known about it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TopOne {
    /// The place asked about: answers to one query (with and without its place in the database)
    /// share it, and so do queries that show the same place.
    pub place: usize,
    /// What the value of the best answer counts for (`ScoreKind::evidence`): ln(1 + S) where
    /// candidates are ranked by S; `None` if it was not re-ranked.
    pub evidence: Option<f64>,
    /// Its Euclidean distance.
    pub global_distance: f64,
    /// Whether it is a positive; false where no match exists.
    pub correct: bool,
    /// Whether the database searched shows the place at all.
    pub has_match: bool,
}

/// An answer with the confidence given to it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prediction {
    /// Probability, 0 to 1, that it is right.
    pub confidence: f64,
    /// Whether it is.
    pub correct: bool,
    /// Whether the database searched shows the place at all.
    pub has_match: bool,
}
