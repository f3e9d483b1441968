//! The gradients of frames, last frames first.

use eddy_inference::checkpoint::plan::FrameStage;

use crate::{
    device::{List, Pointer, Queue, Shape, count},
    error::Result,
    kernels::frame::{
        cells::{ActivationBackward, CellsBackward, ClearPadding},
        encoder::EncoderPointsGradient,
        loss::LossGradient,
    },
};

use super::{LayerMemory, Training, forward::Decoded, maximum::Maximum};

impl Training {
    /// The gradients of frames `first..first + frames`, and with the first ones the weights' and their change.
    pub(super) fn backward(&self, first: usize, frames: usize) -> Result<()> {
        self.stages.iter().rev().try_for_each(|&stage| match stage {
            FrameStage::Decode => self.decoder_backward(first, frames),
            FrameStage::Mix => self.mixer_backward(first, frames),
            FrameStage::Core(number) => self.core_backward(number, first, frames),
            // Both poolings have one encoder, whose gradient comes at the end.
            stage if stage == self.stages[0] => self.encoder_backward(first, frames),
            FrameStage::Means | FrameStage::Maxima => Ok(()),
        })
    }

    /// The gradients of the loss, the decoder and the activation before it.
    fn decoder_backward(&self, first: usize, frames: usize) -> Result<()> {
        let Decoded { from, frames, mixed, d_mixed, output } = self.decoded(first, frames);
        let (rows, last) = (frames * self.settings.batch, first == 0);
        self.launch(
            self.particles(frames),
            LossGradient {
                states: self.states.pointer(),
                output: self.output.pointer(),
                store: self.bodies(),
                windows: self.tables.windows.pointer(),
                progress: self.tables.progress.pointer(),
                material: self.store.material.pointer(),
                weights: self.tables.error_weights.pointer(),
                scales: self.scales.pointer(),
                density: self.density_gradient.as_ref().map_or(Pointer::NULL, List::pointer),
                carried: self.carried.pointer(),
                f: self.frames_argument(),
                first: count(from),
            },
        )?;
        let (mixed_all, output_all) = (self.mixed.pointer(), self.output.pointer());
        self.learn(last, &self.layout.decoder, mixed_all, output_all, self.decoded_rows())?;
        self.backward_product(&self.layout.decoder, output, d_mixed, rows, false)?;
        self.launch(self.units(frames), ActivationBackward { d: d_mixed, y: mixed })?;
        self.change(last, &self.layout.decoder)
    }

    fn mixer_backward(&self, first: usize, frames: usize) -> Result<()> {
        let (batch, wide) = (self.settings.batch, self.constants.hidden_columns());
        let Decoded { from, frames, d_mixed, .. } = self.decoded(first, frames);
        let (top, last) = (self.layers.len() - 1, first == 0);
        let signal = self.outputs(top).plus(self.settings.first_decoded() * batch * wide);
        let mixer = &self.layout.mixer;
        self.learn(last, mixer, signal, self.d_mixed.pointer(), self.decoded_rows())?;
        let gradient = self.at(&self.layers[top].gradient, from, wide);
        self.backward_product(mixer, d_mixed, gradient, frames * batch, false)?;
        self.change(last, mixer)
    }

    /// Rows of all frames that the decoder runs on.
    fn decoded_rows(&self) -> usize {
        (self.frames() - self.settings.first_decoded()) * self.settings.batch
    }

    /// The gradients of both Linears before the core, and those by the particles of frames that were predicted.
    fn encoder_backward(&self, first: usize, frames: usize) -> Result<()> {
        let (batch, wide) = (self.settings.batch, self.constants.hidden_columns());
        let (rows, all, last) = (frames * batch, self.frames() * batch, first == 0);
        // The gradient by the second Linear's outputs for the means; that of a pooling by the mean alone is there already.
        let mean = match &self.maximum {
            None => {
                let d_input = self.at(&self.d_input, first, wide);
                self.launch(
                    Shape::new(rows.div_ceil(128), 1, 128),
                    ClearPadding { d: d_input, rows: count(rows) },
                )?;
                Some(&self.d_input)
            }
            Some(Maximum { d_mean: Some(d_mean), .. }) => {
                self.mean_part(d_mean, first, frames)?;
                Some(d_mean)
            }
            Some(_) => None,
        };
        if last {
            self.device.wait(Queue::Side, Queue::Main)?;
            if let Some(mean) = mean {
                let pooled = self.pooled.pointer();
                self.weight_product(&self.layout.pooled, pooled, mean.pointer(), all)?;
            }
            if let Some(maximum) = &self.maximum {
                self.learn_maxima(maximum, all)?;
            }
            self.measure(&self.layout.pooled)?;
        }
        if let Some(mean) = mean {
            let d_pooled = self.at(&self.d_pooled, first, self.constants.pooled_columns());
            let slopes = self.at(mean, first, wide);
            self.backward_product(&self.layout.pooled, slopes, d_pooled, rows, false)?;
        }
        if last {
            self.change(last, &self.layout.pooled)?;
            return self.learn_points(all);
        }
        if let Some(maximum) = &self.maximum {
            self.maxima_by_points(maximum, first)?;
        }
        if mean.is_none() {
            return Ok(());
        }
        self.launch(
            self.particles(1),
            EncoderPointsGradient {
                states: self.at(&self.states, first, self.constants.particles),
                material: self.store.material.pointer(),
                windows: self.tables.windows.pointer(),
                progress: self.tables.progress.pointer(),
                w: self.weight(&self.layout.points),
                scaling: self.scaling.pointer(),
                g: self.at(&self.d_pooled, first, self.constants.pooled_columns()),
                carried: self.carried.pointer(),
            },
        )
    }

    /// Where the outputs of a layer of the core start.
    pub(super) fn outputs(&self, number: usize) -> Pointer<f32> {
        let layer = &self.layers[number];
        match &layer.dropped {
            Some(dropped) => dropped.pointer(),
            None => self.at(&layer.states, 1, self.constants.hidden_columns()),
        }
    }

    /// The gradients of a layer of the core.
    fn core_backward(&self, number: usize, first: usize, frames: usize) -> Result<()> {
        let (batch, rows, wide) =
            (self.settings.batch, frames * self.settings.batch, self.constants.hidden_columns());
        let (layer, (matrix, recurrent)) = (&self.layers[number], &self.layout.core[number]);
        let gates = matrix.columns;
        let gradient = self.at(&layer.gradient, first, wide);
        if layer.dropped.is_some() {
            self.dropout(number, gradient, gradient, first, frames, 0.0)?;
        }
        match (recurrent, &layer.recurrent) {
            (Some(recurrent), Some(products)) => {
                for t in (first..first + frames).rev() {
                    self.cells_backward(layer, gates, t, 1)?;
                    let products = self.at(products, t, gates);
                    let carried = layer.carried.pointer();
                    self.backward_product(recurrent, products, carried, batch, true)?;
                }
            }
            _ => self.cells_backward(layer, gates, first, frames)?,
        }
        let (last, all) = (first == 0, self.frames() * batch);
        let (input, d_input) = match number {
            0 => (self.input.pointer(), self.at(&self.d_input, first, matrix.rows)),
            _ => {
                let gradient = &self.layers[number - 1].gradient;
                (self.outputs(number - 1), self.at(gradient, first, wide))
            }
        };
        let slopes = self.at(&layer.sums, first, gates);
        self.learn(last, matrix, input, layer.sums.pointer(), all)?;
        self.backward_product(matrix, slopes, d_input, rows, false)?;
        self.change(last, matrix)?;
        if let (Some(recurrent), Some(products)) = (recurrent, &layer.recurrent) {
            self.learn(last, recurrent, layer.states.pointer(), products.pointer(), all)?;
            self.change(last, recurrent)?;
        }
        Ok(())
    }

    /// The gradients by the sums and the carried state, of frames `first..first + frames`.
    fn cells_backward(
        &self,
        layer: &LayerMemory,
        gates: usize,
        first: usize,
        frames: usize,
    ) -> Result<()> {
        let wide = self.constants.hidden_columns();
        self.launch(
            self.units(1),
            CellsBackward {
                sums: self.at(&layer.sums, first, gates),
                recurrent: self.recurrent(layer, gates, first),
                states: self.at(&layer.states, first, wide),
                list: self.numbers_of_states(),
                d_output: self.at(&layer.gradient, first, wide),
                carried: layer.carried.pointer(),
                frames: count(frames),
            },
        )
    }
}
