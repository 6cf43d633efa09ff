//! Recall on data sets: readers, measures, reports.
