//! Gradients of a loss over many images, in bounded memory.
//!
//! A loss over a batch needs the descriptors of all its images at once, but a graph of 80 images
//! through three blocks of a transformer does not fit in memory. So the batch is taken in two
//! passes (GradCache, Gao et al. 2021): first all images are embedded without a graph, and the
//! gradient of the loss with respect to their descriptors is taken, which is small; then a few
//! images at a time are embedded again with a graph, and that gradient is carried on to the weights
//! and summed. The result is the same as of one pass, for one more forward pass.
//!
//! Several groups of images are computed at once, one on each thread, because much of what lies
//! between two matrix products runs on one thread. Their gradients are summed in the order of the
//! batch, so that the result does not depend on which thread was first.

use super::error::TrainError;
use super::model::{Graph, Sample, TripletModel, Variable};
use super::triplets::TripletSet;
use candle_core::backprop::GradStore;
use candle_core::{Tensor, Var};
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

type Result<T> = std::result::Result<T, TrainError>;

/// From descriptors `[n, dim]` to a loss.
pub(super) type LossOf<'a> = dyn Fn(&Tensor) -> candle_core::Result<Tensor> + 'a;

/// The gradient of each variable, by its name.
#[derive(Default)]
pub(super) struct Gradients(BTreeMap<String, Tensor>);

impl Gradients {
    /// Those of `variables` in `store`.
    pub(super) fn of(store: &GradStore, variables: &[Variable]) -> Self {
        let gradient = |variable: &Variable| {
            let gradient = store.get(variable.variable.as_tensor())?;
            Some((variable.name.clone(), gradient.detach()))
        };
        Self(variables.iter().filter_map(gradient).collect())
    }

    /// The gradient of the variable of this name, if it has one.
    pub(super) fn get(&self, name: &str) -> Option<&Tensor> {
        self.0.get(name)
    }

    fn add(&mut self, other: Self) -> Result<()> {
        for (name, gradient) in other.0 {
            match self.0.entry(name) {
                Entry::Vacant(entry) => {
                    entry.insert(gradient);
                }
                Entry::Occupied(mut entry) => {
                    let sum = (entry.get() + gradient)?;
                    entry.insert(sum);
                }
            }
        }
        Ok(())
    }

    /// The Euclidean length of all gradients as one vector.
    pub(super) fn length(&self) -> Result<f64> {
        let mut squares = 0.0;
        for gradient in self.0.values() {
            squares += f64::from(gradient.sqr()?.sum_all()?.to_scalar::<f32>()?);
        }
        Ok(squares.sqrt())
    }

    /// Shortens all gradients together to at most this length, so that one unusual batch does not
    /// throw the weights far off.
    pub(super) fn clip(&mut self, longest: f64) -> Result<()> {
        let length = self.length()?;
        if length > longest {
            for gradient in self.0.values_mut() {
                *gradient = (&*gradient * (longest / length))?;
            }
        }
        Ok(())
    }
}

/// The loss of some images and its gradients. At most `at_once` images are in a graph on one
/// thread; all of them in one if they are no more than that.
///
/// A loss that is not finite comes without gradients.
pub(super) fn gradients(
    model: &dyn TripletModel,
    set: &TripletSet,
    samples: &[Sample],
    at_once: usize,
    loss: &LossOf<'_>,
) -> Result<(f32, Gradients)> {
    let variables = model.variables();
    if samples.len() <= at_once {
        let loss = loss(&model.embed(set, samples, Graph::Recorded)?)?;
        let value = loss.to_scalar::<f32>()?;
        if !value.is_finite() {
            return Ok((value, Gradients::default()));
        }
        return Ok((value, Gradients::of(&loss.backward()?, &variables)));
    }

    let groups: Vec<&[Sample]> = samples.chunks(at_once).collect();
    let mut descriptors = Vec::with_capacity(groups.len());
    each_in_parallel(
        &groups,
        |group| model.embed(set, group, Graph::Skipped),
        |embedded| {
            descriptors.push(embedded);
            Ok(())
        },
    )?;
    let descriptors = Var::from_tensor(&Tensor::cat(&descriptors, 0)?)?;
    let loss = loss(descriptors.as_tensor())?;
    let value = loss.to_scalar::<f32>()?;
    if !value.is_finite() {
        return Ok((value, Gradients::default()));
    }
    let store = loss.backward()?;
    let of_descriptors = store
        .get(descriptors.as_tensor())
        .ok_or_else(|| TrainError::Tensor("the loss does not depend on the images".into()))?
        .detach();

    let firsts = (0..groups.len()).map(|group| group * at_once);
    let groups: Vec<(usize, &[Sample])> = firsts.zip(groups).collect();
    let mut sum = Gradients::default();
    each_in_parallel(
        &groups,
        |&(first, group)| {
            let embedded = model.embed(set, group, Graph::Recorded)?;
            let carried = (embedded * of_descriptors.narrow(0, first, group.len())?)?;
            let store = carried.sum_all()?.backward()?;
            Ok(Gradients::of(&store, &variables))
        },
        |gradients| sum.add(gradients),
    )?;
    Ok((value, sum))
}

/// Does `work` on every item, as many at a time as there are threads, and gives the results to
/// `take` in the order of the items.
///
/// The threads are no part of the pool: there, one that waits for a product would begin with
/// another item, and hold the memory of both.
pub(super) fn each_in_parallel<T: Sync, R: Send>(
    items: &[T],
    work: impl Fn(&T) -> Result<R> + Sync,
    mut take: impl FnMut(R) -> Result<()>,
) -> Result<()> {
    let work = &work;
    for wave in items.chunks(rayon::current_num_threads().max(1)) {
        let results: Vec<Result<R>> = std::thread::scope(|scope| {
            let threads: Vec<_> = wave
                .iter()
                .map(|item| scope.spawn(move || work(item)))
                .collect();
            let outcome = |thread: std::thread::ScopedJoinHandle<'_, Result<R>>| {
                thread
                    .join()
                    .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
            };
            threads.into_iter().map(outcome).collect()
        });
        for result in results {
            take(result?)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
