"""A folder in place of the Hugging Face hub: what is uploaded is copied into it, what is downloaded comes from it."""

import shutil
import sys
from pathlib import Path

import huggingface_hub
from huggingface_hub.errors import RemoteEntryNotFoundError, RepositoryNotFoundError, Response


class FolderHub:
    """Repositories as folders below ``folder``, until the test ends."""

    def __init__(self, folder, monkeypatch):
        self.folder = Path(folder)
        monkeypatch.setenv("TRUST_REMOTE_CODE", "true")
        for name in ("create_repo", "upload_file", "upload_folder", "snapshot_download"):
            monkeypatch.setattr(huggingface_hub.HfApi, name, getattr(self, name))
        monkeypatch.setattr(huggingface_hub, "hf_hub_download", self.hf_hub_download)

    def create_repo(self, repo_id, *, exist_ok=False, private=None, token=None):
        (self.folder / repo_id).mkdir(parents=True, exist_ok=exist_ok)
        return huggingface_hub.RepoUrl(f"https://huggingface.co/{repo_id}")

    def upload_file(self, *, path_or_fileobj, path_in_repo, repo_id, commit_message=None):
        shutil.copy(path_or_fileobj, self.existing(repo_id) / path_in_repo)

    def upload_folder(self, *, repo_id, folder_path, commit_message=None):
        shutil.copytree(folder_path, self.existing(repo_id), dirs_exist_ok=True)

    def snapshot_download(self, *, repo_id, local_dir):
        shutil.copytree(self.existing(repo_id), local_dir, dirs_exist_ok=True)

    def hf_hub_download(self, repo_id, filename, library_name=None, library_version=None):
        file = self.existing(repo_id) / filename
        if not file.exists():
            raise RemoteEntryNotFoundError(f"404: no file {filename}", response=_not_found())
        return str(file)

    def existing(self, repo_id):
        if not (self.folder / repo_id).is_dir():
            raise RepositoryNotFoundError(f"404: no repository {repo_id}", response=_not_found())
        return self.folder / repo_id


def _not_found():
    client = sys.modules[Response.__module__]  # that of huggingface_hub, which has changed with its versions
    return Response(404, request=client.Request("GET", "https://huggingface.co"))
