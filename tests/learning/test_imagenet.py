"""The ResNet's weights come from torchvision's own file, and no pickle runs on the way."""

import collections
import dataclasses
import http.server
import threading

import pytest
import torch

from far_app.errors import CheckpointError
from far_app.learning.encoder import ResNet18Camera
from far_app.learning.imagenet import resnet18_weights
from far_app.learning.policy import DiffusionPolicy, preset
from far_app.learning.torch_zip import read_state_dict
from far_app.learning.train_policy import load_imagenet


def resnet_state() -> dict[str, torch.Tensor]:
    """A state dict with torchvision's names (BatchNorm, a classifier), random weights."""
    torch.manual_seed(1)
    trunk = ResNet18Camera(32, norm="batch").state_dict()
    state = {k: v for k, v in trunk.items() if not k.startswith(("keypoints", "head"))}
    return state | {"fc.weight": torch.randn(1000, 512), "fc.bias": torch.randn(1000)}


def test_a_pth_file_is_read_without_unpickling(tmp_path, monkeypatch):
    state = collections.OrderedDict(resnet_state())
    state["view"] = torch.arange(24.0).view(4, 6)[:, ::2]
    torch.save(state, tmp_path / "r.pth")
    monkeypatch.setattr("torch.load", None)
    again = read_state_dict(tmp_path / "r.pth")
    assert list(again) == list(state)
    assert all(torch.equal(again[k], v) for k, v in state.items())


def test_a_file_with_anything_but_tensors_is_refused(tmp_path):
    class Evil:
        def __reduce__(self):
            return (print, ("this must never be printed",))

    torch.save({"a": Evil()}, tmp_path / "evil.pth")
    with pytest.raises(CheckpointError, match="has no place in a state dict"):
        read_state_dict(tmp_path / "evil.pth")
    torch.save({"a": 3}, tmp_path / "number.pth")
    with pytest.raises(CheckpointError, match="more than named tensors"):
        read_state_dict(tmp_path / "number.pth")
    (tmp_path / "torn.pth").write_bytes((tmp_path / "number.pth").read_bytes()[:200])
    with pytest.raises(CheckpointError, match="not a readable zip"):
        read_state_dict(tmp_path / "torn.pth")


def test_every_camera_s_trunk_gets_the_weights(tmp_path):
    state = resnet_state()
    torch.save(state, tmp_path / "r.pth")
    config = dataclasses.replace(preset("paper", "lift"), image_size=32, widths=(16, 32, 64))
    policy = DiffusionPolicy(config)
    load_imagenet(policy, resnet18_weights(tmp_path / "r.pth"))
    nets = [net for nets in policy.encoder.nets.values() for net in nets]
    assert len(nets) == 4
    assert all(torch.equal(net.layer3[1].conv2.weight, state["layer3.1.conv2.weight"]) for net in nets)


def test_offline_the_message_says_how_to_proceed(tmp_path, monkeypatch):
    monkeypatch.setattr("far_app.learning.imagenet.CACHE", tmp_path)
    with pytest.raises(CheckpointError, match=r"cannot be reached .*--imagenet FILE"):
        resnet18_weights(url="http://127.0.0.1:1/resnet18-f37072fd.pth")
    with pytest.raises(CheckpointError, match="no ImageNet weights at"):
        resnet18_weights(tmp_path / "none.pth")


def test_a_download_of_another_hash_is_thrown_away(tmp_path, monkeypatch):
    class Other(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"not the weights")

        def log_message(self, *arguments):
            pass

    monkeypatch.setattr("far_app.learning.imagenet.CACHE", tmp_path)
    with http.server.HTTPServer(("127.0.0.1", 0), Other) as server:
        threading.Thread(target=server.handle_request, daemon=True).start()
        with pytest.raises(CheckpointError, match="gave a file of hash"):
            resnet18_weights(url=f"http://127.0.0.1:{server.server_port}/resnet18-f37072fd.pth")
    assert list(tmp_path.iterdir()) == []
