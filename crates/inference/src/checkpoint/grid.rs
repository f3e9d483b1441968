//! The layers on the particle model's grid, in order: what each reads and writes. The engine, burn and the GPU follow this list; the
//! engine combines the first and the last one with others, and has widths of its own for them.

use super::{GridOptions, layout::NODE_FEATURES};
use crate::kernels::nodes::MAX_LEVELS;

/// The nodes that a layer reads for a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stencil {
    /// The 3 x 3 around it.
    Neighbours,
    /// Its 2 x 2 children in the next finer level.
    Children,
    /// Its parent in the next coarser level.
    Parent,
}

impl Stencil {
    /// Number of nodes read.
    pub fn places(self) -> usize {
        match self {
            Self::Neighbours => 9,
            Self::Children => 4,
            Self::Parent => 1,
        }
    }

    /// Number of nodes with a matrix of their own: the children of a parent.
    pub fn children(self) -> usize {
        match self {
            Self::Neighbours | Self::Children => 1,
            Self::Parent => 4,
        }
    }
}

/// A layer on the grid. Each reads what the one before has written; the first one, the sums over particles.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GridLayer {
    /// Name of the layer.
    pub name: String,
    /// What it reads.
    pub stencil: Stencil,
    /// Level of the nodes that it writes to; 0 is the finest.
    pub level: usize,
    /// Channels of a node that it reads, and of one that it writes.
    pub channels: [usize; 2],
    /// The layer whose output is added (skip connection): each that reads parents has one.
    pub skip: Option<usize>,
    /// Whether ReLU follows: of all but the last one.
    pub rectified: bool,
    /// The lists of [`grid_lists`] that it reads and writes.
    pub lists: [usize; 2],
}

impl GridLayer {
    /// Level of the nodes that it is computed for one by one: where it reads parents, theirs.
    pub fn node_level(&self) -> usize {
        match self.stencil {
            Stencil::Neighbours | Stencil::Children => self.level,
            Stencil::Parent => self.level + 1,
        }
    }
}

/// The layers on the grid, in order: down to the coarsest level and up again.
pub fn grid_layers(grid: &GridOptions) -> Vec<GridLayer> {
    let channels = &grid.channels;
    let coarsest = channels.len() - 1;
    let mut layers: Vec<GridLayer> = Vec::new();
    let mut add = |level: usize, part: &str, stencil: Stencil, skip: Option<usize>| {
        let before = layers.last();
        let read = before.map_or(channels[0] + NODE_FEATURES, |layer| layer.channels[1]);
        let from = before.map_or(WRITTEN, |layer| layer.lists[1]);
        // The two lists of a level are written in turn.
        let written = layers.iter().filter(|layer| layer.level == level).count();
        layers.push(GridLayer {
            name: format!("grid.{level}.{part}"),
            stencil,
            level,
            channels: [read, channels[level]],
            skip,
            rectified: true,
            lists: [from, 1 + 2 * level + written % 2],
        });
        layers.len() - 1
    };
    add(0, "a", Stencil::Neighbours, None);
    let mut last = vec![add(0, "b", Stencil::Neighbours, None)];
    for level in 1..=coarsest {
        add(level, "down", Stencil::Children, None);
        last.push(add(level, "a", Stencil::Neighbours, None));
    }
    add(coarsest, "b", Stencil::Neighbours, None);
    for level in (0..coarsest).rev() {
        add(level, "up", Stencil::Parent, Some(last[level]));
        add(level, if level == 0 { "c" } else { "b" }, Stencil::Neighbours, None);
    }
    if let Some(last) = layers.last_mut() {
        last.rectified = false;
    }
    layers
}

/// The list that particles are summed in: averages, mass, and proximity to the four walls.
pub const WRITTEN: usize = 0;
/// The list that particles gather from.
pub const READ: usize = 2;
/// The most lists that there can be.
pub const MAX_LISTS: usize = 1 + 2 * MAX_LEVELS;

/// Level and width of the lists of features at nodes that a prediction needs, in which each layer overwrites what is no longer
/// read: the one that particles are summed in, and two for each level. (For its gradients, training keeps the outputs of all
/// layers.)
pub fn grid_lists(grid: &GridOptions) -> Vec<(usize, usize)> {
    let pairs = grid.channels.iter().enumerate().flat_map(|(level, &width)| [(level, width); 2]);
    std::iter::once((0, grid.channels[0] + NODE_FEATURES)).chain(pairs).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layers(channels: &[usize]) -> Vec<GridLayer> {
        grid_layers(&GridOptions { cell_width: 0.1, channels: channels.to_vec(), spacing: 0.1 })
    }

    #[test]
    fn layers_go_down_to_the_coarsest_level_and_up_again() {
        use Stencil::{Children, Neighbours, Parent};
        let two = [
            ("grid.0.a", Neighbours, [10, 5], None, [0, 1]),
            ("grid.0.b", Neighbours, [5, 5], None, [1, 2]),
            ("grid.1.down", Children, [5, 6], None, [2, 3]),
            ("grid.1.a", Neighbours, [6, 6], None, [3, 4]),
            ("grid.1.b", Neighbours, [6, 6], None, [4, 3]),
            ("grid.0.up", Parent, [6, 5], Some(1), [3, 1]),
            ("grid.0.c", Neighbours, [5, 5], None, [1, 2]),
        ];
        let three = [
            ("grid.0.a", Neighbours, [10, 5], None, [0, 1]),
            ("grid.0.b", Neighbours, [5, 5], None, [1, 2]),
            ("grid.1.down", Children, [5, 6], None, [2, 3]),
            ("grid.1.a", Neighbours, [6, 6], None, [3, 4]),
            ("grid.2.down", Children, [6, 7], None, [4, 5]),
            ("grid.2.a", Neighbours, [7, 7], None, [5, 6]),
            ("grid.2.b", Neighbours, [7, 7], None, [6, 5]),
            ("grid.1.up", Parent, [7, 6], Some(3), [5, 3]),
            ("grid.1.b", Neighbours, [6, 6], None, [3, 4]),
            ("grid.0.up", Parent, [6, 5], Some(1), [4, 1]),
            ("grid.0.c", Neighbours, [5, 5], None, [1, 2]),
        ];
        let four = [
            ("grid.0.a", Neighbours, [10, 5], None, [0, 1]),
            ("grid.0.b", Neighbours, [5, 5], None, [1, 2]),
            ("grid.1.down", Children, [5, 6], None, [2, 3]),
            ("grid.1.a", Neighbours, [6, 6], None, [3, 4]),
            ("grid.2.down", Children, [6, 7], None, [4, 5]),
            ("grid.2.a", Neighbours, [7, 7], None, [5, 6]),
            ("grid.3.down", Children, [7, 8], None, [6, 7]),
            ("grid.3.a", Neighbours, [8, 8], None, [7, 8]),
            ("grid.3.b", Neighbours, [8, 8], None, [8, 7]),
            ("grid.2.up", Parent, [8, 7], Some(5), [7, 5]),
            ("grid.2.b", Neighbours, [7, 7], None, [5, 6]),
            ("grid.1.up", Parent, [7, 6], Some(3), [6, 3]),
            ("grid.1.b", Neighbours, [6, 6], None, [3, 4]),
            ("grid.0.up", Parent, [6, 5], Some(1), [4, 1]),
            ("grid.0.c", Neighbours, [5, 5], None, [1, 2]),
        ];
        let channels = [5, 6, 7, 8];
        for expected in [&two[..], &three[..], &four[..]] {
            let levels = (expected.len() + 1) / 4;
            let found = layers(&channels[..levels]);
            let found: Vec<_> = found
                .iter()
                .map(|l| (l.name.as_str(), l.stencil, l.channels, l.skip, l.lists))
                .collect();
            assert_eq!(found, expected);
        }
    }

    #[test]
    fn no_list_is_overwritten_before_it_is_read() {
        for levels in GridOptions::LEVELS {
            let layers = layers(&[1; MAX_LEVELS][..levels]);
            let mut writer = [None; MAX_LISTS];
            for (number, layer) in layers.iter().enumerate() {
                let [from, to] = layer.lists;
                assert_ne!(from, to);
                assert_eq!(writer[from], number.checked_sub(1), "layer {number}");
                if let Some(skip) = layer.skip {
                    assert_eq!(writer[layers[skip].lists[1]], Some(skip), "layer {number}");
                }
                assert_eq!(layer.rectified, number + 1 < layers.len());
                writer[to] = Some(number);
            }
            assert_eq!(writer[READ], Some(layers.len() - 1));
        }
    }
}
