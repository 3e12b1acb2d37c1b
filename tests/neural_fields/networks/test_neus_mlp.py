import torch
from mplicits.neural_fields.networks.neus_mlp import NeusSDF


def test_neus_has_the_published_size_and_begins_as_a_sphere() -> None:
    torch.manual_seed(0)
    field = NeusSDF()
    assert sum(parameter.numel() for parameter in field.parameters()) == 529_076
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=1)
    with torch.inference_mode():
        assert float(field.value(0.2 * directions).max()) < 0
        assert float(field.value(0.9 * directions).min()) > 0
        gradient = torch.nn.functional.normalize(field.jet(0.6 * directions).gradient, dim=1)
    assert float((gradient * directions).sum(dim=1).mean()) > 0.9
